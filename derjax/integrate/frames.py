"""Many steps of time, with memory for derivatives that grows like their square root."""

import math
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ..core.pytree import pytree, replace
from ..core.status import SolverError, Status, explain
from ..rods.rod import State
from .step import Scene, Step
from .step_size import AFTER_FAILURE, StepSizeController

SEGMENTS, TRIES = 32, 32
"""Of steps that adapt, whose product is the most tries that there may be in one frame."""

FULL = 0.1
"""Of the length to begin with: a first step that is longer may lack places for contacts."""


@pytree
class RolloutStats:
    """How the steps of a rollout went.

    Attributes:
        status: of the first failed step, else `Status.OK`.
        failed_at: s, start of the first failed step.
        steps: steps completed.
        iterations: Newton iterations of them all, tries included that were rejected.
        factorings: Newton matrices that were factored for them.
        residual: largest scaled residual of a completed step; of the failed one, if any.
        rejected: steps that were given up for shorter ones, if steps adapt.
        next_length: s, of the step that is tried next, if steps adapt; 0 at the start.
    """

    status: Int[Array, ""]
    failed_at: Float[Array, ""]
    steps: Int[Array, ""]
    iterations: Int[Array, ""]
    factorings: Int[Array, ""]
    residual: Float[Array, ""]
    rejected: Int[Array, ""]
    next_length: Float[Array, ""]

    @property
    def ok(self) -> bool:
        """Whether every step converged."""
        return bool(self.status == Status.OK)

    def message(self) -> str:
        """A sentence on how the run ended."""
        return explain(int(self.status), float(self.failed_at), float(self.residual))

    def raise_if_failed(self) -> None:
        """Raise `SolverError` with the time, the residual and advice, if a step failed."""
        if not self.ok:
            raise SolverError(self.message())


def new_stats() -> RolloutStats:
    """The statistics of a run that has not begun."""
    count = jnp.zeros((), jnp.int32)
    nothing = jnp.zeros(())
    # Types that are not weak, as those of a run that has begun: one program serves for both.
    never = jnp.array(jnp.nan, float)
    return RolloutStats(count, never, count, count, count, nothing, count, nothing)


@pytree
class _Run:
    """A run in the middle of a frame.

    Attributes:
        state: where it is.
        report: how it went.
        left: steps to the end of the frame, or s if steps adapt.
    """

    state: State
    report: RolloutStats
    left: Array


def _fixed(scene: Scene, run: _Run) -> _Run:
    """One step of the scene's length."""
    step = scene.scheme(scene, run.state, scene.step_length)
    good = step.info.status == Status.OK
    return replace(_taken(run, step, good, step.info.status), left=run.left - 1)


def _adaptive(scene: Scene, run: _Run, control: StepSizeController) -> _Run:
    """One try of a step; what is left of the frame is divided into equal ones.

    Derivatives are those of a run with the same lengths of steps: they do not depend on
    how a length follows from the motion.
    """
    proposed = jnp.where(run.report.next_length > 0, run.report.next_length, scene.step_length)
    count = jnp.maximum(jnp.ceil(run.left / lax.stop_gradient(proposed) - 1e-6), 1.0)
    length = run.left / count
    step = scene.scheme(scene, run.state, length)
    excess = control.excess(lax.stop_gradient(step.error))
    solved = step.info.status == Status.OK
    good = solved & (excess <= 1.0)
    factor = jnp.where(solved, control.factor(excess), AFTER_FAILURE)
    shorter = length * jnp.minimum(factor, 1.0)
    following = jnp.where(good & (factor >= 1.0), jnp.maximum(proposed, factor * length), shorter)
    # The list of contacts is shorter for a shorter step, but where it is full for one no longer
    # than the last, steps would become shorter and shorter: it needs more places.
    last = lax.stop_gradient(run.state.history.lengths[0])
    short = length <= jnp.where(last > 0.0, last, FULL * scene.step_length)
    full = (step.info.status == Status.CAPACITY) & short
    hopeless = (following < control.shortest) | full | (step.info.status == Status.OVERLAP)
    reason = jnp.where(solved, Status.TOO_SHORT, step.info.status)
    status = jnp.where(good | ~hopeless, Status.OK, reason)
    new = _taken(run, step, good, status)
    report = replace(
        new.report,
        rejected=run.report.rejected + (~good).astype(jnp.int32),
        next_length=following,
    )
    left = jnp.where(good, jnp.where(count > 1.0, run.left - length, 0.0), run.left)
    return replace(new, report=report, left=left)


def _taken(run: _Run, step: Step, good: Array, status: Array) -> _Run:
    """With the step taken if it is good. If not, the state stays as it was."""
    report, residual = run.report, lax.stop_gradient(step.info.residual)
    failed = status != Status.OK
    worst = jnp.where(good, jnp.maximum(report.residual, residual), report.residual)
    return replace(
        run,
        state=jax.tree.map(lambda a, b: jnp.where(good, a, b), step.state, run.state),
        report=replace(
            report,
            status=status.astype(jnp.int32),
            failed_at=jnp.where(failed, lax.stop_gradient(run.state.time), report.failed_at),
            steps=report.steps + good.astype(jnp.int32),
            iterations=report.iterations + step.info.iterations,
            factorings=report.factorings + step.info.factorings,
            residual=jnp.where(failed, residual, worst),
        ),
    )


def roll_frames(
    scene: Scene,
    state: State,
    n_frames: int,
    steps_per_frame: int,
    report: RolloutStats | None = None,
) -> tuple[State, RolloutStats]:
    """The states at the ends of frames, and how the steps went.

    Differentiable in forward and reverse mode. In reverse mode only the states at the ends
    of about sqrt(steps) segments are kept, and one segment at a time is run again with its
    states kept; Newton's iterations are never replayed a second time. If steps adapt, the
    derivatives are those at the sequence of lengths that was found.

    Args:
        scene: what to simulate.
        state: where to start.
        n_frames: number of frames, f.
        steps_per_frame: length of a frame, in steps of the scene's length.
        report: of the run that this one continues; a run that has failed stays where it is.

    Returns:
        The state at the end of every frame (a `State` whose leaves have a leading axis f) and
        a `RolloutStats`. After a failed step the state no longer changes.
    """
    adapts = scene.control is not None
    if adapts:
        n_segments, length = SEGMENTS, TRIES
    else:
        wanted = max(1, min(steps_per_frame, math.isqrt(n_frames * steps_per_frame)))
        n_segments = math.ceil(steps_per_frame / wanted)
        length = math.ceil(steps_per_frame / n_segments)

    @partial(jax.checkpoint, policy=jax.checkpoint_policies.save_only_these_names("state"))
    def step(run, _):
        return lax.cond(_going(run), partial(_attempt, scene), lambda run: run, run), None

    @jax.checkpoint
    def steps(run):
        return lax.scan(step, run, None, length=length)[0]

    def segment(run, _):
        if not adapts:
            return steps(run), None
        return lax.cond(_going(run), steps, lambda run: run, run), None

    def within(run):
        return lax.scan(segment, run, None, length=n_segments)[0]

    return _frames(scene, state, n_frames, steps_per_frame, report, within)


def march_frames(
    scene: Scene,
    state: State,
    n_frames: int,
    steps_per_frame: int,
    report: RolloutStats | None = None,
) -> tuple[State, RolloutStats]:
    """`roll_frames` without reverse mode: a frame ends as soon as its steps are taken.

    Under `jax.vmap` a batch of runs ends a frame with the last of them. `roll_frames` would then
    take, for every run, as many tries as there may ever be.
    """

    def within(run):
        def wanted(carry):
            count, run = carry
            return _going(run) & ((scene.control is None) | (count < SEGMENTS * TRIES))

        def step(carry):
            count, run = carry
            return count + 1, _attempt(scene, run)

        return lax.while_loop(wanted, step, (jnp.zeros((), jnp.int32), run))[1]

    return _frames(scene, state, n_frames, steps_per_frame, report, within)


def _going(run: _Run) -> Array:
    """Whether there is more to do in a frame."""
    return (run.left > 0) & (run.report.status == Status.OK)


@jax.jit
def _attempt(scene: Scene, run: _Run) -> _Run:
    """One try of a step; compiled, so that JAX traces it once for all programs and loops.

    Loops within loops would else be traced again, several times each, for every derivative.
    """
    if scene.control is None:
        return _fixed(scene, run)
    return _adaptive(scene, run, scene.control)


def _frames(
    scene: Scene,
    state: State,
    n_frames: int,
    steps_per_frame: int,
    report: RolloutStats | None,
    within: Callable[[_Run], _Run],
) -> tuple[State, RolloutStats]:
    """The states at the ends of frames; `within` takes the steps of one."""
    if scene.control is None:
        whole = jnp.array(steps_per_frame, jnp.int32)
    else:
        whole = lax.stop_gradient(steps_per_frame * scene.step_length)

    def frame(carry, _):
        state, report = carry
        run = within(_Run(state, report, whole))
        unfinished = _going(run)
        report = replace(
            run.report,
            status=jnp.where(unfinished, Status.TOO_MANY, run.report.status).astype(jnp.int32),
            failed_at=jnp.where(
                unfinished, lax.stop_gradient(run.state.time), run.report.failed_at
            ),
        )
        return (run.state, report), run.state

    start = (state, new_stats() if report is None else report)
    (_, report), states = lax.scan(frame, start, None, length=n_frames)
    return states, report
