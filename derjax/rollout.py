"""Many steps of time, with memory for derivatives that grows like their square root."""

import math
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from .pytree import pytree
from .rod import State
from .status import SolverError, Status, explain
from .step import Scene


@pytree
class Report:
    """How the steps of a rollout went.

    Attributes:
        status: of the first failed step, else `Status.OK`.
        failed_at: s, start of the first failed step.
        steps: steps completed.
        iterations: Newton iterations of them all.
        residual: largest scaled residual of a completed step; of the failed one, if any.
    """

    status: Int[Array, ""]
    failed_at: Float[Array, ""]
    steps: Int[Array, ""]
    iterations: Int[Array, ""]
    residual: Float[Array, ""]

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


def new_report() -> Report:
    """The report of a run that has not begun."""
    count = jnp.zeros((), jnp.int32)
    return Report(count, jnp.array(jnp.nan), count, count, jnp.zeros(()))


def _advance_and_report(scene: Scene, state: State, report: Report) -> tuple[State, Report]:
    """One step. A failed one leaves the state as it was, for every later step too."""
    new, info = scene.step(scene, state)
    good = info.status == Status.OK
    kept = jax.tree.map(lambda a, b: jnp.where(good, a, b), new, state)
    residual = lax.stop_gradient(info.residual)
    return kept, Report(
        status=info.status,
        failed_at=jnp.where(good, report.failed_at, lax.stop_gradient(state.time)),
        steps=report.steps + good.astype(jnp.int32),
        iterations=report.iterations + info.iterations,
        residual=jnp.where(good, jnp.maximum(report.residual, residual), residual),
    )


def rollout(
    scene: Scene,
    state: State,
    n_frames: int,
    steps_per_frame: int,
    report: Report | None = None,
) -> tuple[State, Report]:
    """The states after every `steps_per_frame` steps, and how the steps went.

    Differentiable in forward and reverse mode. In reverse mode only the states at the ends
    of about sqrt(steps) segments are kept, and one segment at a time is run again with its
    states kept; Newton's iterations are never replayed a second time.

    Args:
        scene: what to simulate.
        state: where to start.
        n_frames: number of frames, f.
        steps_per_frame: steps between frames.
        report: of the run that this one continues; a run that has failed stays where it is.

    Returns:
        The state at the end of every frame (a `State` whose leaves have a leading axis f) and
        a `Report`. After a failed step the state no longer changes.
    """
    wanted = max(1, min(steps_per_frame, math.isqrt(n_frames * steps_per_frame)))
    n_segments = math.ceil(steps_per_frame / wanted)
    length = math.ceil(steps_per_frame / n_segments)

    @partial(jax.checkpoint, policy=jax.checkpoint_policies.save_only_these_names("state"))
    def step(carry, _):
        state, report, left = carry
        state, report = lax.cond(
            (left > 0) & (report.status == Status.OK),
            partial(_advance_and_report, scene),
            lambda state, report: (state, report),
            state,
            report,
        )
        return (state, report, left - 1), None

    @jax.checkpoint
    def segment(carry, _):
        carry, _ = lax.scan(step, carry, None, length=length)
        return carry, None

    def frame(carry, _):
        state, report = carry
        left = jnp.array(steps_per_frame, jnp.int32)
        (state, report, _), _ = lax.scan(segment, (state, report, left), None, length=n_segments)
        return (state, report), state

    start = (state, new_report() if report is None else report)
    (_, report), states = lax.scan(frame, start, None, length=n_frames)
    return states, report
