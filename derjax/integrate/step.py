"""What every scheme of integration in time is made of: stages of implicit Euler.

In a stage of length l that starts from an origin q~ and a velocity v~, the end q makes the
incremental potential

    P(q) = E(q) + l Phi((q - q~)/l; q_m) + |q - q~ - l v~|^2_M / (2 l^2) - f . q

of the scene's terms stationary. With q~ and v~ those of the state this is a step of implicit
Euler; the stages of the diagonally implicit Runge-Kutta methods have the same form, with an
origin that takes in the stages before. Drag is linear in the velocity at a configuration q_m,
which is that where the rod is expected to be.
"""

from collections.abc import Callable
from dataclasses import field
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Float

from ..core.pytree import pytree, replace, static
from ..core.status import SolverError, Status
from ..rods.kinematics import positions, tangents
from ..rods.rod import Rod, State, transport_frames
from ..solve.blocks import Layout
from ..solve.contributions import Dofs, Mobility
from ..solve.newton import NewtonInfo, NewtonSettings, equilibrium
from ..solve.potential import Potential, assemble
from ..solve.saddle import SaddlePointSystem, no_drag
from ..terms.motor import TorqueMotor
from ..terms.term import Prediction, Stage, Term, contributions
from .motor import Motor
from .predictor import expected_displacement, with_step
from .provenance import CheckSums, changed, for_enlarged
from .step_size import StepSizeController

T = TypeVar("T", bound=Term)


@pytree
class Step:
    """A step that has been tried.

    Attributes:
        state: at its end.
        info: how the solver did.
        error: (d,) m and rad, estimate of what the step adds to the error.
    """

    state: State
    info: NewtonInfo
    error: Dofs


@pytree
class Scene:
    """Everything that does not change during a run.

    The terms that a scene has are part of its structure: what is not in `terms` is not in
    the compiled program. All numbers are leaves and can be differentiated.

    Attributes:
        rod: topology and stress-free shape.
        terms: the physical ingredients.
        motor: what turns `rod.topology.motors` or `driven_edges`, be it of prescribed rates or of
            limited torque; None without motors.
        newton: when the solver stops.
        step_length: s, of a step, or of the first one if steps adapt to the motion.
        scheme: how one step of some length is taken.
        control: how the length of steps adapts; None for steps of one length.
        layout: the blocks in which a large robot is solved for; None for one dense matrix.
        parameters: the numbers that the scene was built of, by their names in scene files and in
            the units that they have there: for the record, no step asks them.
        check_sums: of the terms that it was built with; see `provenance`.
        initial: the state in which it starts, if that is known; see `start`.
        source: the scene file that it was built from; None for scenes made in another way.
    """

    rod: Rod
    terms: tuple[Term, ...]
    motor: Motor | TorqueMotor | None
    newton: NewtonSettings
    step_length: Float[Array, ""]
    scheme: Callable[["Scene", State, Array], Step] = static()
    control: StepSizeController | None = None
    layout: Layout | None = None
    parameters: dict[str, Array] = field(default_factory=dict)
    check_sums: CheckSums = field(default_factory=dict)
    initial: State | None = None
    source: Any = static(default=None)

    @property
    def start(self) -> State:
        """The state in which the scene starts: the robot at rest.

        Raises:
            ValueError: the scene was made by hand, without a state.
        """
        if self.initial is None:
            raise ValueError("this scene has no initial state; give it one with initial=state")
        return self.initial

    __iter__ = None  # else Python would look for terms by number

    def __getitem__(self, kind: type[T]) -> T:
        """The one term of some kind, as `scene[derjax.Contact]`.

        Raises:
            KeyError: the scene has no such term, or several.
        """
        found = [term for term in self.terms if isinstance(term, kind)]
        if len(found) != 1:
            names = ", ".join(type(term).__name__ for term in self.terms)
            raise KeyError(f"{len(found)} terms are a {kind.__name__}; the scene has {names}")
        return found[0]

    def replace(self, **parameters: Any) -> "Scene":
        """The scene with some parameters changed, by name, as `scene.replace(pitch=0.05)`.

        What does not follow from the parameters stays: terms that were added are kept.
        Differentiable; also under `jax.jit`.

        Args:
            parameters: by the keys of `scene.parameters`, in the units that they have there.

        Raises:
            KeyError: a parameter that the scene does not have.
            InputError: a number that cannot be.
            ValueError: the scene was not built from a scene file, or one of the terms that it was
                built with has been replaced.
        """
        if self.source is None:
            raise ValueError(
                "only scenes that were built from a scene file know how their parts follow from "
                "parameters; use dataclasses.replace(scene, field=...) for parts of this one"
            )
        self._check_as_built()
        return self.source.rebuilt(self, parameters)

    def number(self, name: str) -> float:
        """A parameter that is one number, by its name.

        Raises:
            KeyError: a parameter that the scene does not have.
            ValueError: it has a value for each flagellum or motor.
        """
        if name not in self.parameters:
            known = ", ".join(self.parameters) or "none, as it was not built from a scene file"
            raise KeyError(f"{name}: no such parameter; the scene has {known}")
        if np.ndim(self.parameters[name]) > 0:
            raise ValueError(f"{name}: has several values; this needs one number")
        return float(self.parameters[name])

    def with_term(self, *terms: Term) -> "Scene":
        """The scene with more physical ingredients."""
        return replace(self, terms=(*self.terms, *terms))

    def _check_as_built(self) -> None:
        """Refuses to lose what has been done to terms that follow from parameters."""
        built = self.terms[: len(self.check_sums)]
        names = [type(term).__name__ for term in built]
        known = sorted(name for name, _ in self.check_sums)
        if sorted(names) != known:
            raise ValueError(
                f"the scene was built with the terms {', '.join(known)}, and now has "
                f"{', '.join(names)}: build it anew, and then change its terms"
            )
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(self)):
            return  # numbers that are traced cannot be compared
        if others := changed(built, self.check_sums):
            raise ValueError(
                f"the numbers of {', '.join(others)} are not those that follow from the scene's "
                "parameters: build it anew, and then change its terms"
            )

    def __repr__(self) -> str:
        topology = self.rod.topology
        size = f"{topology.n_nodes} nodes, {topology.n_edges} edges"
        lines = [f"Scene of {size}, scheme {self.scheme.__name__}"]
        lines.append("  terms: " + ", ".join(type(term).__name__ for term in self.terms))
        lines += [f"  {name} = {_short(value)}" for name, value in self.parameters.items()]
        return "\n".join(lines)


def enlarge(scene: Scene) -> Scene:
    """The scene with room for twice as many contacts at one time.

    Raises:
        SolverError: no term has a list that could be longer.
    """
    terms = tuple(term.enlarged() for term in scene.terms)
    if jax.tree.structure(terms) == jax.tree.structure(scene.terms):
        names = ", ".join(type(term).__name__ for term in scene.terms)
        raise SolverError(
            f"a list of fixed length is full, and none of the terms can have a longer one: {names}"
        )
    sums = for_enlarged(scene.check_sums, scene.terms, terms)
    return replace(scene, terms=terms, check_sums=sums)


def _short(value: Any) -> str:
    """A number on a line: its value, or what JAX knows of it."""
    if isinstance(value, Tracer) or not hasattr(value, "shape"):
        return str(value)
    return f"{float(value):.6g}" if np.ndim(value) == 0 else f"array of shape {np.shape(value)}"


def predicted_displacement(scene: Scene, state: State, ahead: Array) -> Dofs:
    """How far (m, rad) the rod goes in some time (s), if motion goes on as it did."""
    return expected_displacement(scene.rod.topology, state, ahead, scene.newton.force_scale)


def predict(scene: Scene, state: State, ahead: Array, length: Array) -> Prediction:
    """What the terms are told before a step of some length (s) from `state`.

    Drag is that of the configuration some time (s) ahead.
    """
    configuration = state.q + predicted_displacement(scene, state, ahead)
    return Prediction(configuration, predicted_displacement(scene, state, length), scene.terms)


def fluid_velocity(scene: Scene, q: Dofs, time: Array) -> Dofs | None:
    """The velocity (m/s) of the fluid at every node and its spin (rad/s) about every edge.

    None if no term makes the fluid flow.

    Args:
        scene: whose terms.
        q: (d,) m and rad, where the rod is.
        time: s.
    """
    topology = scene.rod.topology

    def parts(x: Array) -> list[Array]:
        each = (term.fluid_velocity(x, time) for term in scene.terms)
        return [velocity for velocity in each if velocity is not None]

    def flow(x: Array) -> Array:
        return jnp.asarray(sum(parts(x)))

    nodes = positions(topology, q)
    if not parts(nodes[0]):
        return None
    start, end = topology.edge_nodes.T
    gradient = jax.vmap(jax.jacfwd(flow))(0.5 * (nodes[start] + nodes[end]))
    vorticity = jnp.stack(
        [gradient[:, k, j] - gradient[:, j, k] for j, k in ((1, 2), (2, 0), (0, 1))], axis=1
    )
    spin = 0.5 * jnp.sum(vorticity * tangents(topology, nodes), axis=1)
    return jnp.concatenate([jax.vmap(flow)(nodes).ravel(), spin])


def moving_stage(scene: Scene, state: State, velocity: Dofs, acceleration: Dofs) -> Stage:
    """A stage of unit length that ends where the state is: forces at one moment of a motion.

    Args:
        scene: whose fluid may flow.
        state: where the rod is.
        velocity: (d,) m/s and rad/s.
        acceleration: (d,) m/s^2 and rad/s^2.
    """
    return Stage(
        length=jnp.ones(()),
        time=state.time,
        motor_angle=state.motor_angle,
        origin=state.q - velocity,
        velocity=velocity - acceleration,
        fluid_velocity=fluid_velocity(scene, state.q, state.time),
        motor_origin=state.motor_angle - state.motor_rate,
    )


def motor_rotation(scene: Scene, state: State, length: Array) -> Float[Array, " k"]:
    """Angle (rad) that the motors turn in the next `length` (s), or are expected to."""
    if scene.motor is None:
        return jnp.zeros_like(state.motor_angle)
    return scene.motor.expected_turn(state, length)


def acting_terms(scene: Scene) -> tuple[Term, ...]:
    """The terms of a scene, and its motors if what they do depends on the load."""
    return (*scene.terms, scene.motor) if isinstance(scene.motor, Term) else scene.terms


def motor_angle(
    scene: Scene, state: State, stage: Stage, prediction: Prediction, q: Dofs
) -> Float[Array, " k"]:
    """rad, of the motors at the end of a stage that has been solved for.

    Args:
        scene: whose motors.
        state: at the start of the step.
        stage: that has been solved for.
        prediction: of the step.
        q: (d,) m and rad, its solution.
    """
    if scene.motor is None:
        return stage.motor_angle
    return scene.motor.angle_after(scene.rod, state, stage, prediction, q)


def solve(
    scene: Scene,
    prediction: Prediction,
    state: State,
    stage: Stage,
    turn: Float[Array, " k"],
    move: Dofs,
) -> tuple[Dofs, NewtonInfo]:
    """The end of a stage of the step that starts at `state`.

    Differentiable in forward and reverse mode. A failure gives the best iterate and a status.

    Args:
        scene: whose rod and solver.
        prediction: for the step.
        state: at the start of the step.
        stage: what to solve.
        turn: rad, by which the motors have turned at its end.
        move: (d,) m and rad, expected from the start of the step to the end of the stage.

    Raises:
        TypeError: a term answers with something that is no contribution.
        ValueError: a term answers with one that the scene's solver does not take.
    """
    topology = scene.rod.topology
    parts = contributions(acting_terms(scene), scene.rod, state, stage, prediction)
    mobilities = [c for c in parts if isinstance(c, Mobility)]
    potential = assemble([c for c in parts if not isinstance(c, Mobility)])
    if potential.guards:
        move = potential.max_step(state.q, move) * move
    guess = state.q + move
    if topology.driven_edges:
        dofs = topology.edge_dofs(topology.driven_edges)
        guess = guess.at[dofs].set(state.q[dofs] + turn, unique_indices=True)
    free = None
    if topology.fixed_dofs:
        free = tuple(topology.free_dofs.tolist())
    settings = scene.newton
    if scene.control is not None:
        settings = replace(settings, negligible=scene.control.negligible_move)
    if scene.layout is None:
        _check_no_mobility(mobilities)
        q, info = equilibrium(potential, guess, settings, free)
    else:
        drag = _only_mobility(scene.layout, mobilities)
        q, info = _in_blocks(scene.rod, scene.layout, settings, potential, drag, guess)
    if potential.guards:
        fault = potential.status(lax.stop_gradient(q))
        status = jnp.where(info.status == Status.OK, fault, info.status)

        def blamed() -> Array:
            before = potential.status(lax.stop_gradient(state.q))
            return jnp.where(before == Status.PENETRATION, Status.OVERLAP, status)

        status = lax.cond(status != Status.OK, blamed, lambda: status).astype(jnp.int32)
        info = replace(info, status=status)
    return q, info


def _check_no_mobility(mobilities: list[Mobility]) -> None:
    """Refuses what a dense matrix cannot be made of."""
    if mobilities:
        raise ValueError(
            "a scene without layout is solved for with one dense matrix, which cannot take the "
            "drag of BlockStokeslets; build the scene with [solver] method = 'dense', or have "
            "StokesletSegments in their place"
        )


def _only_mobility(layout: Layout, mobilities: list[Mobility]) -> Mobility:
    """The non-local drag of a robot in blocks: there can be one."""
    if len(mobilities) > 1:
        raise ValueError(
            f"{len(mobilities)} terms have a Mobility, as BlockStokeslets do: a robot in blocks "
            "can have one, in which all that drags it is added up"
        )
    if not mobilities:
        return no_drag(layout)
    (drag,) = mobilities
    blocks, size = layout.nodes[..., 0].size, 3 * layout.size
    if drag.law.resistance.shape != (blocks, size, size):
        raise ValueError(
            "the blocks of the drag are not those of scene.layout: they must be one Layout"
        )
    return drag


def _in_blocks(
    rod: Rod,
    layout: Layout,
    settings: NewtonSettings,
    potential: Potential,
    drag: Mobility,
    guess: Dofs,
) -> tuple[Dofs, NewtonInfo]:
    """The end of a stage of a large robot."""
    topology = rod.topology
    if layout.topology != topology:
        raise ValueError("scene.layout is that of another robot: it must have scene.rod.topology")
    free = np.ones(topology.n_dofs)
    free[list(topology.fixed_dofs)] = 0.0
    scale = lax.stop_gradient(settings.force_scale)
    saddle = SaddlePointSystem(potential, drag, layout, guess, jnp.asarray(free), scale)

    def and_forces(of_moves: Dofs | float, of_forces: float) -> Dofs:
        wet = jnp.full(saddle.drag.dofs.array.size, of_forces)
        return saddle.join(jnp.broadcast_to(jnp.asarray(of_moves), guess.shape), wet)

    settings = replace(
        settings,
        force_scale=saddle.scales,
        size=and_forces(settings.size, 0.0),
        negligible=and_forces(settings.negligible, jnp.inf),
    )
    z, info = equilibrium(saddle, saddle.start(guess), settings, None)
    return saddle.split(z)[0], info


def finish_step(
    scene: Scene,
    state: State,
    length: Array,
    q: Dofs,
    velocity: Dofs,
    acceleration: Dofs,
    motor_angle: Float[Array, " k"],
    motor_rate: Float[Array, " k"],
) -> State:
    """The state after a step from `state` to `q`, with what is known of its end."""
    new = transport_frames(scene.rod, replace(state, motor_angle=motor_angle), q)
    return replace(
        new,
        velocity=velocity,
        acceleration=acceleration,
        motor_rate=motor_rate,
        time=state.time + length,
        history=with_step(state, length, q),
    )
