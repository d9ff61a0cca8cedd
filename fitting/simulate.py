"""Simulated tracks with their derivatives, of any length from one compiled program.

For a few parameters the derivatives are carried forward in time with the states: the tangents
are nothing but more right-hand sides for the matrix that the step has factored anyway, and
nothing has to be stored. The rollout is compiled for a number of steps and called as often
as a run needs it, so runs of all lengths and motor rates share the program, and the host
can look in between: for progress, for an interruption, for a failed step.
"""

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from derjax import RolloutStats, Scene, SceneFile, State, build, roll_frames
from derjax.core.programs import stored
from derjax.integrate.frames import march_frames, new_stats
from derjax.terms.contact.repulsion import Contact

from .observe import orientations, seen
from .screw import Motion
from .tracks import Run
from .transforms import Parameters

STEPS_PER_CALL = 100
"""Steps between two looks of the host at a run."""


@dataclass(frozen=True)
class SimulatedTrack:
    """What a camera with a frame at every step would see.

    Attributes:
        time: (t,) s, from 0.
        observed: (t, 4) the channels of `observe.CHANNELS`: m, m, m, rad.
        sensitivity: (t, 4, p) their derivatives with respect to the free parameters.
        orientation: (t, 3, 3) of the head; see `observe.orientations`.
        turning: (t, 3, 3, p) its derivatives.
        report: how the steps went; observations after a failed step mean nothing.
    """

    time: Float[np.ndarray, " t"]
    observed: Float[np.ndarray, "t 4"]
    sensitivity: Float[np.ndarray, "t 4 p"]
    orientation: Float[np.ndarray, "t 3 3"]
    turning: Float[np.ndarray, "t 3 3 p"]
    report: RolloutStats

    @property
    def motion(self) -> Motion:
        """The motion without its derivatives."""
        return Motion(self.observed, self.orientation)

    def moved(self, parameter: int, change: float) -> Motion:
        """The motion after a small change of one free parameter."""
        return Motion(
            self.observed + change * self.sensitivity[..., parameter],
            self.orientation + change * self.turning[..., parameter],
        )


def build_with(
    scene: SceneFile, parameters: Parameters, free: Float[Array, " p"], rpm: Array
) -> tuple[Scene, State]:
    """The scene at a free vector and a motor rate; differentiable, and may be compiled."""
    built = build(scene, {**parameters.values(free), "rpm": rpm})
    return built, built.start


def motor_rate(scene: SceneFile, run: Run) -> Array:
    """Revolutions per minute of the motor in a run: its own, or that of the scene."""
    return jnp.asarray(scene.parameters["rpm"] if run.motor_rpm is None else run.motor_rpm, float)


def simulate(
    scene: SceneFile,
    parameters: Parameters,
    free: Float[Array, " p"],
    rpm: Array,
    n_steps: int,
    sight: int | None = None,
) -> tuple[Float[Array, "t 4"], RolloutStats]:
    """Observations (m, rad) at steps 0 to `n_steps`; a function for JAX to differentiate.

    For reverse mode, which suits many parameters; see `Simulator` for few.
    """
    built, state = build_with(scene, parameters, free, rpm)
    states, report = roll_frames(built, state, n_steps, 1)
    whole = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), state, states)
    return seen(built, whole, sight), report


def _seen(built: Scene, states: State, sight: int | None) -> Motion:
    both: Any = seen(built, states, sight), orientations(built.rod.topology, states)
    return Motion(*both)


@partial(stored, static=(0, 1, 4))
def _begin(
    scene: SceneFile, parameters: Parameters, free: Array, rpm: Array, sight: int | None
) -> Any:
    """State and observation at rest, and their tangents along every free parameter."""

    def start(free):
        built, state = build_with(scene, parameters, free, rpm)
        return state, _seen(built, jax.tree.map(lambda x: x[None], state), sight)

    push = jax.vmap(lambda along: jax.jvp(start, (free,), (along,)), out_axes=(None, 0))
    return push(jnp.eye(free.size))


@partial(stored, static=(0, 1, 2, 8))
def _continue(
    scene: SceneFile,
    parameters: Parameters,
    n_steps: int,
    free: Array,
    rpm: Array,
    state: State,
    tangents: State,
    report: RolloutStats,
    sight: int | None,
) -> Any:
    """`n_steps` more steps: ((state, observations), report), tangents of the former."""

    def go_on(free, state):
        built, _ = build_with(scene, parameters, free, rpm)
        states, new = march_frames(built, state, n_steps, 1, report)
        last = jax.tree.map(lambda x: x[-1], states)
        return (last, _seen(built, states, sight)), new

    def push(along, tangent):
        primal, moved, new = jax.jvp(go_on, (free, state), (along, tangent), has_aux=True)
        return (primal, new), moved

    return jax.vmap(push, out_axes=(None, 0))(jnp.eye(free.size), tangents)


class Cancelled(Exception):
    """The simulation was asked to stop."""


@dataclass(frozen=True)
class Simulator:
    """Simulates the runs of a dataset with sensitivities.

    Attributes:
        scene: what to simulate.
        parameters: what to differentiate with respect to.
        steps_per_call: length of the compiled rollout; runs are rounded up to a multiple.
        sight: along which axis silhouettes are seen; None if the head is followed.
    """

    scene: SceneFile
    parameters: Parameters
    steps_per_call: int = STEPS_PER_CALL
    sight: int | None = None

    def enlarged(self) -> "Simulator":
        """One whose lists of contacts have room for twice as many, which is another program."""
        contacts = [t for t in build(self.scene).terms if isinstance(t, Contact)]
        room = self.scene.contact.model_copy(update={"capacity": 2 * contacts[0].capacity})
        return replace(self, scene=self.scene.model_copy(update={"contact": room}))

    def compile(self, free: Float[np.ndarray, " p"], rpm: Array) -> None:
        """Compile beforehand; otherwise runs that start at once would each compile."""
        self.run(free, rpm, 1)

    def run(
        self,
        free: Float[np.ndarray, " p"],
        rpm: Array,
        n_steps: int,
        on_steps: Callable[[int], None] = lambda steps: None,
        enough: Callable[[Motion], bool] = lambda motion: False,
    ) -> SimulatedTrack:
        """At least `n_steps` steps (fewer after a failed one, and when there is `enough`).

        Args:
            free: (p,) free parameters.
            rpm: motor rate, or one for every entry of the scene's motor table.
            n_steps: steps wanted.
            on_steps: called with the number of steps after every call of the program; may
                raise to stop the simulation.
            enough: asked after every call of the program with the motion so far.
        """
        z = jnp.asarray(free)
        (state, seen), (tangents, d_seen) = _begin(self.scene, self.parameters, z, rpm, self.sight)
        seen_so_far, moved_so_far = [jax.device_get(seen)], [jax.device_get(d_seen)]
        report = new_stats()
        done = 0
        while done < n_steps and report.ok:
            ((state, seen), report), (tangents, d_seen) = _continue(
                self.scene,
                self.parameters,
                self.steps_per_call,
                z,
                rpm,
                state,
                tangents,
                report,
                self.sight,
            )
            seen_so_far.append(jax.device_get(seen))
            moved_so_far.append(jax.device_get(d_seen))
            done += self.steps_per_call
            on_steps(self.steps_per_call)
            if enough(_joined(seen_so_far, 0)):
                break
        motion, moved = _joined(seen_so_far, 0), _joined(moved_so_far, 1)
        return SimulatedTrack(
            time=self.scene.step * np.arange(done + 1),
            observed=motion.observed,
            sensitivity=np.moveaxis(moved.observed, 0, -1),
            orientation=motion.orientation,
            turning=np.moveaxis(moved.orientation, 0, -1),
            report=report,
        )

    def runs(
        self,
        free: Float[np.ndarray, " p"],
        rates: Sequence[Array],
        n_steps: Sequence[int],
        on_steps: Callable[[int], None] = lambda steps: None,
        enough: Sequence[Callable[[Motion], bool]] | None = None,
    ) -> list[SimulatedTrack]:
        """Several runs at once, one on each processor; arguments as of `run`.

        Raises:
            KeyboardInterrupt: after the other runs have been stopped as well.
        """
        stop_all = threading.Event()
        if enough is None:
            enough = [lambda motion: False] * len(rates)

        def checked(steps: int) -> None:
            if stop_all.is_set():
                raise Cancelled
            on_steps(steps)

        with ThreadPoolExecutor(min(len(rates), _processors())) as pool:
            futures = [
                pool.submit(self.run, free, rate, n, checked, stop)
                for rate, n, stop in zip(rates, n_steps, enough, strict=True)
            ]
            try:
                return [future.result() for future in futures]
            except BaseException:
                stop_all.set()
                for future in futures:
                    future.cancel()
                raise


def _joined(pieces: Sequence[Motion], axis: int) -> Motion:
    """Pieces of a motion in a row; `axis` is that of time."""
    return Motion(*(np.concatenate(parts, axis) for parts in zip(*pieces, strict=True)))


def steps_per_call(longest: int) -> int:
    """A length of the compiled rollout that wastes few steps on a run of `longest` steps."""
    calls = max(1, -(-longest // STEPS_PER_CALL))
    return max(1, -(-longest // calls))


def _processors() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
