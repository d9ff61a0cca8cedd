"""What is said about input, that it is wrong or may not mean what it seems to, and about files."""


class InputError(ValueError):
    """Something is wrong with what the user gave; the message names file, key or line."""


class InputWarning(UserWarning):
    """Something that the user gave can be used, but perhaps not as it was meant."""


class SolverWarning(RuntimeWarning):
    """A step failed, and a run ends where it began; the message says when, and what to try."""


class WriteWarning(UserWarning):
    """A file could not be written; what is done goes on without it."""
