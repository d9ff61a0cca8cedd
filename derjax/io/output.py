"""The directory that a command writes its results to."""

from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from ..core.errors import InputError
from .files import atomic_path, writable_directory
from .locking import locked

Signature = tuple[int, int, int]


class Output:
    """A directory of results while a command fills it.

    The command may replace the files that it found there at its start, and its own; those that
    come from elsewhere meanwhile it leaves alone.

    Attributes:
        path: of the directory, which exists.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._known: dict[str, Signature | None] = {}
        self.include(".")

    def include(self, directory: str) -> None:
        """Counts what is in a directory below this one among what was found at the start."""
        for file in (self.path / directory).glob("*"):
            self._known[str(file.relative_to(self.path))] = _signature(file)

    def check(self, names: Iterable[str]) -> None:
        """`InputError` if one of these files must not be replaced."""
        for name in names:
            path = self.path / name
            now = _signature(path)
            if now is not None and now != self._known.get(str(Path(name))):
                raise InputError(
                    f"{path}: was written by another program since this one began; "
                    "it is not replaced"
                )

    @contextmanager
    def replacing(self, name: str) -> Iterator[Path]:
        """A temporary path for the block to write, which then takes the place of the file.

        Raises:
            InputError: it must not be replaced.
            WriteError: it cannot be written.
        """
        self.check([name])
        path = self.path / name
        with atomic_path(path) as temporary:
            yield temporary
            self.check([name])
        self._known[str(Path(name))] = _signature(path)

    def remove(self, name: str) -> None:
        """Deletes a file that may be replaced; does nothing if there is none, or another's."""
        with suppress(InputError):
            self.check([name])
            (self.path / name).unlink(missing_ok=True)


@contextmanager
def output_directory(path: Path, exclusive: bool = True) -> Iterator[Output]:
    """Makes sure that results can be written to a directory, before anything is computed.

    It is made if it is not there; if the block leaves it empty, it is gone again.

    Args:
        path: of the directory.
        exclusive: whether to keep other programs out of it.

    Raises:
        InputError: it cannot be written to, or another program writes there.
    """
    made = [part for part in (path, *path.parents) if not part.exists()]
    try:
        writable_directory(path)
        with ExitStack() as stack:
            if exclusive:
                stack.enter_context(locked(path))
            yield Output(path)
    finally:
        with suppress(OSError):
            for part in made:
                part.rmdir()


def _signature(path: Path) -> Signature | None:
    """What is another one as soon as a file has been replaced or changed; None without file."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns, found.st_size
