"""A run of a scene from Python, and what came out of it."""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ..core.errors import SolverWarning
from ..core.pytree import pytree, replace
from ..core.status import Status
from ..integrate.frames import RolloutStats, march_frames, new_stats, roll_frames
from ..integrate.step import Scene, enlarge
from ..rods import head as kinematics
from ..rods.kinematics import positions, tangents
from ..rods.rod import State, moved
from ..rods.vectors import rotation_about
from ..scenes.timing import whole_number
from ..steady.motion import screw
from ..steady.solve import Steady

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

_roll = jax.jit(roll_frames, static_argnums=(2, 3))
_march = jax.jit(march_frames, static_argnums=(2, 3))


@pytree
class Run:
    """What came out of a run: the states at the start and at the end of every frame.

    A pytree: `jax.grad` may go through it, and `jax.jit` may return it.

    Attributes:
        scene: that was run.
        states: a `State` whose leaves have a leading axis of time, t.
        stats: how the steps went.
    """

    scene: Scene
    states: State
    stats: RolloutStats

    @property
    def time(self) -> Float[Array, " t"]:
        """s."""
        return self.states.time

    @property
    def positions(self) -> Float[Array, "t n 3"]:
        """Of the nodes, m."""
        return positions(self.scene.rod.topology, self.states.q)

    @property
    def head_position(self) -> Float[Array, "t 3"]:
        """Of the head's node, m; `ValueError` if there is no head."""
        return kinematics.head_position(self.scene.rod.topology, self.states)

    @property
    def head_angle(self) -> Float[Array, " t"]:
        """By which the head has turned about its own axis, rad; `ValueError` without a head."""
        return kinematics.head_angle(self.scene.rod.topology, self.states)

    @property
    def last(self) -> State:
        """The state at the end."""
        return jax.tree.map(lambda leaf: leaf[-1], self.states)

    def raise_if_failed(self) -> None:
        """Raise `SolverError` with the time, the residual and advice, if a step failed."""
        self.stats.raise_if_failed()

    def to_dataset(self) -> "xr.Dataset":
        """The trajectory with dimensions, units and all parameters; see `trajectory`."""
        from .dataset import to_dataset  # slow to import

        states = {"status": Status(int(self.stats.status)).name.lower()}
        return to_dataset(self.scene, self.states, states)

    def summary(self) -> dict[str, Any]:
        """Speed, head rate and more over the second half of the run; see `summary`."""
        from .summary import summarise

        return summarise(self.to_dataset())

    def plot(self, kind: str = "track") -> "Figure | None":
        """A figure of the run: "track", "shape", "speed" or "bundle".

        None for what the robot does not have: tracks and speeds without a head, or bundles of one
        flagellum.

        Raises:
            ValueError: no such kind of figure.
        """
        from . import plots  # slow to import

        kinds = {f.__name__: f for f in (plots.track, plots.shape, plots.speed, plots.bundle)}
        if kind not in kinds:
            raise ValueError(f"no figure {kind!r}; there are {', '.join(kinds)}")
        return kinds[kind](self.to_dataset())

    def film(self, path: str | Path, **options: Any) -> Path:
        """Writes a film: a .gif, an .mp4 or an .html page in which the robot can be turned.

        Args:
            path: of the film; its ending says which kind. Replaced if it exists.
            options: of `film_of`: fps, speed, begin, end, follow.

        Raises:
            ValueError: another ending.
            InputError: there are less than two frames to show.
        """
        from . import animation  # slow to import
        from .film import film_of
        from .viewer import write_html

        path = Path(path)
        writers = {
            ".gif": animation.write_gif,
            ".mp4": animation.write_mp4,
            ".html": write_html,
        }
        if path.suffix not in writers:
            raise ValueError(f"{path}: films end in {', '.join(writers)}")
        writers[path.suffix](film_of(self.to_dataset(), **options), path)
        return path

    def __repr__(self) -> str:
        topology = self.scene.rod.topology
        if isinstance(self.stats.status, Tracer):
            return f"Run of {topology.n_nodes} nodes, traced"
        return (
            f"Run of {topology.n_nodes} nodes to {float(self.time[-1]):g} s in "
            f"{int(self.stats.steps)} steps, {len(self.time)} frames: {self.stats.message()}"
        )


def rollout(
    scene: Scene,
    end: float | None = None,
    *,
    frame: float | None = None,
    state: State | None = None,
    reverse_mode: bool = True,
) -> Run:
    """Runs a scene. Compiled once for all scenes of one structure.

    Differentiable in forward and reverse mode, with memory that grows like the square root of the
    number of steps. Where a list of contacts is too short, the run is made again with a longer
    one, unless JAX is tracing it, as under `jax.jit` or `jax.grad`. A step that fails is told by a
    `SolverWarning`; see `Run.raise_if_failed`.

    Args:
        scene: what to run, as `build` returns it.
        end: s of simulated time; None for that of the scene file.
        frame: s from one state that is kept to the next; None for that of the scene file, and of
            scenes that were not built from one, for a step.
        state: where to start; None for the scene's own start.
        reverse_mode: False for runs that need no gradient in reverse mode, which are quicker.

    Raises:
        ValueError: `end` is missing, or it is no whole number of frames, or a frame is no
            whole number of steps.
    """
    begin = scene.start if state is None else state
    steps_per_frame, n_frames = _division(scene, end, frame)
    program = _roll if reverse_mode else _march
    states, stats = program(scene, begin, n_frames, steps_per_frame)
    if not isinstance(stats.status, Tracer):
        while stats.status == Status.CAPACITY:
            scene = enlarge(scene)
            states, stats = program(scene, begin, n_frames, steps_per_frame)
        if not stats.ok:
            warnings.warn(stats.message(), SolverWarning, stacklevel=2)
    every = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), begin, states)
    return Run(scene, every, stats)


def steady_run(state: Steady, times: Float[Array, " t"]) -> Run:
    """The run of a robot that swims steadily: its shape moved and turned on, without a step.

    Args:
        state: the steady state.
        times: s, from the moment of the state.
    """
    scene, topology, now = state.scene, state.scene.rod.topology, state.state
    # Frames do not turn about their edges, as in a run: angles do that in their place.
    turning = tangents(topology, positions(topology, now.q)) @ state.motion.rotation
    (first, second), signs = topology.hinge_edges.T, topology.hinge_signs
    twisting = signs[:, 1] * turning[second] - signs[:, 0] * turning[first]
    at_angles = np.arange(topology.n_dofs) >= 3 * topology.n_nodes

    def later(time: Array) -> State:
        there = moved(topology, now, *screw(state.motion.velocity, state.motion.rotation, time))
        along = tangents(topology, positions(topology, there.q))
        return replace(
            there,
            q=there.q + time * jnp.where(at_angles, now.velocity, 0.0),
            reference_director=jax.vmap(
                lambda director, axis, rate: rotation_about(axis, -rate * time) @ director
            )(there.reference_director, along, turning),
            reference_twist=now.reference_twist - time * twisting,
            motor_angle=now.motor_angle + time * state.motor_rate,
            time=now.time + time,
        )

    return Run(scene, jax.vmap(later)(jnp.asarray(times, float)), new_stats())


def _division(scene: Scene, end: float | None, frame: float | None) -> tuple[int, int]:
    """Steps of a frame, and frames of a run."""
    file = None if scene.source is None else scene.source.file
    if not isinstance(scene.step_length, Tracer):
        step = float(scene.step_length)
    elif file is not None:
        step = file.step
    else:
        raise ValueError(
            "a scene without a scene file whose step_length is traced cannot be divided into "
            "steps: use derjax.roll_frames, or keep step_length out of what is differentiated"
        )
    if end is None and file is None:
        raise ValueError("end: must be given (s) for scenes that have no scene file")
    last = file.time.end if end is None and file is not None else end or 0.0
    usual = step if file is None else step * file.steps_per_frame
    each = usual if frame is None else frame
    steps = whole_number(each / step, f"frame = {each:g} s: no whole number of steps of {step:g} s")
    said = f"end = {last:g} s: no whole number of frames of {each:g} s; give another end or frame"
    return steps, whole_number(last / each, said)
