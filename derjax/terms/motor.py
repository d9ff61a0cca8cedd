"""Motors of limited torque: how far their shafts turn is part of what a step solves for.

The torque of a motor falls linearly with its rate w, from its stall torque to none at its free
speed: T = T_0 (w_0 - w) / |w_0|, as that of DC motors with permanent magnets does. Such a motor is
a dashpot of constant c = T_0 / |w_0| that turns with w_0. In a stage of length l, in which the
rate is that from an angle a~, it adds

    c / (2 l) (a - a~ - l w_0)^2

to the incremental potential, whose minimum over the shaft's angle a is where the motor's torque
is that which the hinge passes on. That angle is found inside of the hinge, and taken out of the
step's unknowns: what is left is a function of the hinge's strains.
"""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..core.pytree import Indices, pytree
from ..rods.rod import Rod, State
from ..solve.contributions import Elements
from ..solve.local import Autodiff
from .elastic.bend import Bend
from .elastic.hinge import HingePotential, hinge_frames, strains
from .elastic.twist import Twist
from .term import Prediction, Role, Stage, Term

SEARCHING, DERIVED = 4, 2
"""Newton steps to the angle of a shaft, from that in a hinge that only twists, on a motor without
ripple; and more of them at the solution, through which its first two derivatives are exact."""


class Drive(NamedTuple):
    """What a motor pulls with in a stage, as a function of its shaft's angle from some angle.

    Attributes:
        damping: N m / rad, of the dashpot over the length of the stage.
        free: rad, where the shaft would be with no load.
        start: rad, the angle from which others are measured, for ripple.
        ripple: N m, amplitude of the torque that depends on the angle; None for none.
        order: how often that repeats itself in a turn.
    """

    damping: Array
    free: Array
    start: Array
    ripple: Array | None
    order: Array | None

    def energy(self, angle: Array) -> Array:
        """J, whose negative slope is the torque of the motor."""
        energy = 0.5 * self.damping * (angle - self.free) ** 2
        if self.ripple is None or self.order is None:
            return energy
        return energy + self.ripple / self.order * jnp.cos(self.order * (self.start + angle))


class Hinge(NamedTuple):
    """How a hinge resists: over its length, N m / rad."""

    bending: Array
    twisting: Array


def shaft_energy(
    angle: Array, kappa: Float[Array, " 2"], twist: Array, hinge: Hinge, drive: Drive
) -> Array:
    """J, of a hinge and its motor once the shaft has turned by some angle (rad).

    The hinge is straight when it is free of stress. Its curvature, on the average of the directors
    on both sides, is in proportion to the cosine of half the twist; see `Topology.motor_hinge`.

    Args:
        angle: rad, of the shaft, from where `kappa` and `twist` were found.
        kappa: integrated curvature of the hinge, with the shaft there.
        twist: rad.
        hinge: its stiffness.
        drive: of its motor.
    """
    turned = (1.0 + jnp.cos(twist - angle)) / (1.0 + jnp.cos(twist))
    bending = 0.5 * hinge.bending * jnp.sum(kappa**2) * turned
    return bending + 0.5 * hinge.twisting * (twist - angle) ** 2 + drive.energy(angle)


def shaft_angle(kappa: Float[Array, " 2"], twist: Array, hinge: Hinge, drive: Drive) -> Array:
    """rad, by which the shaft turns: where the torque of the motor is that of the hinge.

    Args:
        kappa: as in `shaft_energy`; so are the others.
        twist: rad.
        hinge: its stiffness.
        drive: of its motor.
    """
    slope: Callable[..., Array] = jax.grad(shaft_energy)
    curvature = jax.grad(slope)
    stiffness = hinge.twisting + drive.damping
    start = (hinge.twisting * twist + drive.damping * drive.free) / stiffness
    given = kappa, twist, hinge, drive
    fixed = lax.stop_gradient(given)
    angle = lax.stop_gradient(start)
    for known in [fixed] * SEARCHING + [given] * DERIVED:
        angle = angle - slope(angle, *known) / curvature(angle, *known)
    return angle


def hinge_energy(
    kappa: Float[Array, " 2"], twist: Array, data: tuple[Hinge, Drive]
) -> Float[Array, ""]:
    """J, by which a hinge with its motor differs from one whose shaft stands still."""
    hinge, drive = data
    still = 0.5 * hinge.bending * jnp.sum(kappa**2) + 0.5 * hinge.twisting * twist**2
    angle = shaft_angle(kappa, twist, hinge, drive)
    return shaft_energy(angle, kappa, twist, hinge, drive) - still


def edge_energy(local: Float[Array, " 1"], data: tuple[Array, Drive]) -> Float[Array, ""]:
    """J, of the motor of an edge that is held in place but for its angle."""
    start, drive = data
    return drive.energy(local[0] - start)


@pytree
class TorqueMotor(Term):
    """Motors whose torque falls linearly with their rate, and may have ripple.

    The torque at an angle a and a rate w is

        T = T_0 (w_0 - w) / |w_0| + r T_0 sin(n a),

    where ripple r is that of cogging or of a gear, n times a turn. They turn the hinges
    `topology.motors`, which must be straight when free of stress and bend like others at every
    angle (`motor_hinge = "rigid"`), or the edges `topology.driven_edges`, whose angles are free.

    Attributes:
        stall_torque: (k,) N m, T_0, positive.
        free_rate: (k,) rad/s, w_0, whose sign is the direction in which a motor turns.
        ripple: (k,) r; None for none.
        ripple_order: (k,) n.
    """

    role: ClassVar[Role] = Role.DRIVE

    stall_torque: Float[Array, " k"]
    free_rate: Float[Array, " k"]
    ripple: Float[Array, " k"] | None = None
    ripple_order: Float[Array, " k"] | None = None

    def torque(self, angle: Float[Array, " k"], rate: Float[Array, " k"]) -> Float[Array, " k"]:
        """N m, with which each motor turns its flagellum against the head.

        Args:
            angle: rad, of each shaft.
            rate: rad/s.
        """
        part = (self.free_rate - rate) / jnp.abs(self.free_rate)
        if self.ripple is not None and self.ripple_order is not None:
            part = part + self.ripple * jnp.sin(self.ripple_order * angle)
        return self.stall_torque * part

    def expected_turn(self, state: State, ahead: Array) -> Float[Array, " k"]:
        """Angle (rad) by which the motors turn in some time (s), if they go on as they do."""
        return ahead * state.motor_rate

    def prepare(self, rod: Rod, state: State, prediction: Prediction) -> Hinge | None:
        if not rod.topology.motors:
            return None
        motors = np.array(rod.topology.motors)
        bend = prediction.only(Bend, "a motor of limited torque")
        twist = prediction.only(Twist, "a motor of limited torque")
        length = rod.hinge_length[motors]
        return Hinge(bend.stiffness[motors] / length, twist.stiffness[motors] / length)

    def contribution(self, rod: Rod, state: State, stage: Stage, cache: Hinge | None) -> Elements:
        drive = self._drive(state, stage)
        if cache is None:
            dofs = rod.topology.edge_dofs(rod.topology.driven_edges)
            start = state.q[dofs] + stage.motor_angle - state.motor_angle
            return Elements(Indices(dofs[:, None]), Autodiff(edge_energy), (start, drive))
        stencil = Indices(rod.topology.hinge_stencil.array[np.array(rod.topology.motors)])
        frames = _at_motors(rod, state, stage)
        return Elements(stencil, HingePotential(hinge_energy), (frames, (cache, drive)))

    def rates(self, states: State) -> Float[Array, "t k"]:
        """rad/s, of every motor in a stack of states."""
        return states.motor_rate

    def angles(self, states: State) -> Float[Array, "t k"]:
        """rad, that every motor has turned up to each of a stack of states."""
        return states.motor_angle + 2 * jnp.pi * states.motor_turns

    def angle_after(
        self, rod: Rod, state: State, stage: Stage, prediction: Prediction, q: Float[Array, " d"]
    ) -> Float[Array, " k"]:
        """rad, of every shaft at the end of a stage.

        Args:
            rod: topology and stress-free shape.
            state: at the start of the step.
            stage: that has been solved for.
            prediction: of the step.
            q: (d,) m and rad, its solution.
        """
        cache = prediction.cache(self, rod, state)
        if cache is None:
            dofs = rod.topology.edge_dofs(rod.topology.driven_edges)
            return state.motor_angle + q[dofs] - state.q[dofs]
        local = q[rod.topology.hinge_stencil.array[np.array(rod.topology.motors)]]
        kappa, twist = jax.vmap(strains)(local, _at_motors(rod, state, stage))
        turned = jax.vmap(shaft_angle)(kappa, twist, cache, self._drive(state, stage))
        return stage.motor_angle + turned

    def _drive(self, state: State, stage: Stage) -> Drive:
        """Of every motor, by angles from `stage.motor_angle`."""
        origin = state.motor_angle if stage.motor_origin is None else stage.motor_origin
        return Drive(
            damping=self.stall_torque / jnp.abs(self.free_rate) / stage.length,
            free=origin + stage.length * self.free_rate - stage.motor_angle,
            start=stage.motor_angle,
            ripple=None if self.ripple is None else self.ripple * self.stall_torque,
            order=self.ripple_order,
        )


def _at_motors(rod: Rod, state: State, stage: Stage) -> Any:
    """Frames at the hinges of motors."""
    frames = hinge_frames(rod, state, stage.motor_angle)
    return jax.tree.map(lambda leaf: leaf[np.array(rod.topology.motors)], frames)
