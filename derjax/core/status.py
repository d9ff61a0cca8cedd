"""How a run ended: an integer inside compiled code, a sentence outside of it."""

import enum


class Status(enum.IntEnum):
    """Outcome of a step; a rollout keeps the first that is not `OK` and freezes there."""

    OK = 0
    MAX_ITERATIONS = 1
    LINE_SEARCH = 2
    NON_FINITE = 3
    PENETRATION = 4
    TOO_FAST = 5
    CAPACITY = 6
    TOO_SHORT = 7
    TOO_MANY = 8
    OVERLAP = 9
    NOT_STEADY = 10


class SolverError(RuntimeError):
    """A rollout that could not be completed; the message says when, how, and what to try."""


_WHAT = {
    Status.MAX_ITERATIONS: "Newton's method did not converge in the allowed number of iterations",
    Status.LINE_SEARCH: "the line search of Newton's method found no step that lowers the residual",
    Status.NON_FINITE: "Newton's method met a value that is not finite",
    Status.PENETRATION: "two rods penetrated each other by more than 1 % of their diameter",
    Status.TOO_FAST: "a rod moved farther than the search for contacts looks in one step",
    Status.CAPACITY: "more pairs of edges came close than the list of contacts has places",
    Status.TOO_SHORT: "no step was short enough to meet the tolerance: the motion is not smooth",
    Status.OVERLAP: "two rods overlap where the step begins",
    Status.TOO_MANY: "a frame needs more steps than a run may take, so short do they have to be",
    Status.NOT_STEADY: "forces change as the robot moves and turns as a whole",
}

_TRY = {
    Status.MAX_ITERATIONS: "a smaller [time] step, or a slower motor",
    Status.LINE_SEARCH: "a smaller [time] step; the rod may be buckling or turning too far in one",
    Status.NON_FINITE: "a smaller [time] step, and for scheme = 'explicit' the implicit scheme",
    Status.PENETRATION: "a larger [contact] stiffness, or a smaller [time] step",
    Status.TOO_FAST: "a smaller [time] step, or a slower motor",
    Status.CAPACITY: "a larger [contact] capacity",
    Status.TOO_SHORT: "a larger [time] tolerance; a rod may be snapping, or driven unevenly",
    Status.OVERLAP: "a start in which they are apart: another separation, phase or shape",
    Status.TOO_MANY: "a shorter [time] frame, a larger [time] tolerance, or a slower motor",
    Status.NOT_STEADY: "a simulation in time",
}


def explain(status: int, time: float, residual: float) -> str:
    """A sentence on a failed step: what happened, when, with what residual, what to try.

    `time` is the start of the failed step (s); `residual` the largest scaled force left.
    """
    code = Status(status)
    if code is Status.OK:
        return "every step converged"
    return (
        f"the step that starts at t = {time:.6g} s failed: {_WHAT[code]} "
        f"(scaled residual {residual:.2e}). Try {_TRY[code]}."
    )
