"""Steady swimming, solved for by Newton's method along growing rates of the motor."""

from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ..core.derivatives import jacobian
from ..core.pytree import pytree, replace
from ..core.status import SolverError, Status
from ..integrate.step import Scene
from ..rods.kinematics import positions, tangents
from ..rods.rod import State
from .motion import (
    RigidMotion,
    Symmetry,
    elastic_stiffness,
    elsewhere,
    gauge,
    held_still,
    moving_imbalance,
    prescribed,
    rates,
    rotating_acceleration,
    state_at,
    steady_imbalance,
    symmetry_of,
    with_part_of_weight,
)

MOST_MATRICES, MOST_TRIES = 8, 40
"""Of Newton's method for one rate of the motor, before a smaller increment is tried."""

CONTRACTION = 0.5
"""By how much the residual must fall in a step for the matrix to be kept."""

FIRST, SMALLEST = 0.5, 1e-4
"""Increments of the motor's rate, as parts of it: the first, and the one that is given up at."""

GROWTH, SHRINK = 2.0, 0.25
"""Of the increment, after one that converged and one that did not."""

ELSEWHERE = 1e-5
"""The largest scaled force in a steady state that is moved and turned as a whole."""

ROUNDING = 100.0
"""Times the tolerance: where rounding leaves no smaller residual, it is small enough."""


@pytree
class Steady:
    """A steady state: a shape that moves as a whole.

    Attributes:
        state: the rod, its velocity, and frames that have been carried from the start.
        motion: of the shape.
        motor_rate: rad/s.
        status: `Status.OK`, or why there is none.
        iterations: of Newton's method.
        residual: largest scaled force that is left.
        scene: whose steady state it is.
        symmetry: in which ways the shape may move.
    """

    state: State
    motion: RigidMotion
    motor_rate: Float[Array, ""]
    status: Int[Array, ""]
    iterations: Int[Array, ""]
    residual: Float[Array, ""]
    scene: Scene
    symmetry: Symmetry

    @property
    def ok(self) -> bool:
        """Whether there is a steady state."""
        return bool(self.status == Status.OK)

    def message(self) -> str:
        """A sentence on why there is no steady state, and what to try."""
        left = f"scaled residual {float(self.residual):.2e}"
        if self.ok:
            return f"all forces balance ({left})"
        if self.status == Status.NOT_STEADY:
            return (
                f"forces change as the robot moves and turns as a whole ({left} elsewhere), so "
                "that it has no steady state: a flow, a force that is fixed in space or that "
                "changes in time, and [motor] hinge = 'published' do that. Simulate it in time."
            )
        if self.scene.motor is None:
            return (
                f"the rod has not come to rest ({Status(int(self.status)).name}, {left}). Try "
                "loads that grow little by little, each from the equilibrium before (guess)."
            )
        reached = float(self.motor_rate) * 60 / (2 * np.pi)
        return (
            f"no steady state was found beyond {reached:.6g} rpm ({left}): the branch may turn "
            "back there. Try a slower motor, another start of the search (guess), or derjax.branch."
        )

    def raise_if_failed(self) -> None:
        """Raise `SolverError` with the rate that was reached, and what to try, if there is none."""
        if not self.ok:
            raise SolverError(self.message())

    @property
    def positions(self) -> Float[Array, "n 3"]:
        """m, of the nodes."""
        return positions(self.scene.rod.topology, self.state.q)

    @property
    def axis(self) -> Float[Array, " 3"]:
        """Direction of the rotation of the shape; that of the start if it does not turn."""
        rotation = self.motion.rotation
        square = jnp.sum(rotation**2)
        turns = square > 0.0
        size = jnp.sqrt(jnp.where(turns, square, 1.0))
        first = tangents(self.scene.rod.topology, self.positions)[0]
        return jnp.where(turns, rotation / size, first)

    @property
    def speed(self) -> Float[Array, ""]:
        """m/s, along the axis of rotation: how fast the robot gets on."""
        return self.motion.velocity @ self.axis

    @property
    def head_rate(self) -> Float[Array, ""]:
        """rad/s, at which the head turns about its own axis."""
        topology = self.scene.rod.topology
        if topology.head is None:
            return jnp.zeros(())
        spins = self.state.velocity[topology.edge_dofs(topology.head.edges)]
        return jnp.mean(spins)

    @property
    def tail_to_head(self) -> Float[Array, ""]:
        """m, from the first node to the last."""
        return jnp.linalg.norm(self.positions[-1] - self.positions[0])


@pytree
class _Point:
    """A place on the way to the rate of the motor.

    Attributes:
        z: (d + m,) degrees of freedom that are free, then unknowns of the motion.
        part: of the motor's rate.
    """

    z: Array
    part: Array


Found = tuple[Array, Array, Array, Array, Array]
"""Unknowns of the steady state, the part of the rate that was reached, status, steps, residual."""


class Equations:
    """The equations of a steady state of a scene, in the unknowns that are free.

    A shape that is moved and turned as a whole solves them as well. The one that is meant has no
    rigid motion from `anchor`, a shape that should be near (d,); None for the start.
    """

    def __init__(self, scene: Scene, symmetry: Symmetry, anchor: Array | None = None) -> None:
        self.scene, self.symmetry = scene, symmetry
        self.free = scene.rod.topology.free_dofs
        self.anchor = scene.start.q if anchor is None else anchor

    def near(self, z: Array) -> "Equations":
        """With the shape at some unknowns as the anchor."""
        return Equations(self.scene, self.symmetry, self.split(z)[0])

    def start(self) -> Array:
        """At rest, where the scene starts."""
        return jnp.concatenate([self.scene.start.q[self.free], jnp.zeros(self.symmetry.size)])

    def rigid(self, part: Array) -> Array:
        """The shape of the start, in the motion in which it has least force and torque."""
        start, count = self.start(), len(self.free)
        turning = replace(self.symmetry, axes=jnp.eye(3))
        still = jnp.zeros(())
        moves = jax.vmap(
            lambda u: rates(
                self.scene, turning, self.scene.start.q, turning.motion(u, still), still
            )
        )(jnp.eye(turning.size))[:, self.free]
        unit = self.scene.newton.force_scale[self.free]

        def left(unknowns: Array) -> Array:
            z = start.at[count:].set(unknowns)
            return moves @ (self.residual(z, part)[:count] * unit)

        force, push = jax.linearize(left, start[count:])
        by_motion = jax.vmap(push, out_axes=1)(jnp.eye(self.symmetry.size))
        return start.at[count:].add(-jnp.linalg.lstsq(by_motion, force)[0])

    def split(self, z: Array) -> tuple[Array, Array]:
        """All degrees of freedom, and the unknowns of the motion."""
        count = len(self.free)
        return self.scene.start.q.at[self.free].set(z[:count]), z[count:]

    def rate(self, part: Array | float) -> Array:
        """rad/s, of the motor; 0 where none turns."""
        if self.scene.motor is None:
            return jnp.zeros(())
        return part * prescribed(self.scene).rate[0, 0]

    def residual(self, z: Array, part: Array | float = 1.0) -> Array:
        """What should vanish, dimensionless: forces in the solver's units, and the gauge."""
        q, unknowns = self.split(z)
        scene = with_part_of_weight(self.scene, part)
        force = steady_imbalance(scene, self.symmetry, q, unknowns, self.rate(part))
        unit = lax.stop_gradient(self.scene.newton.force_scale)
        scaled = (force / unit)[self.free]
        return jnp.concatenate([scaled, gauge(self.scene, self.symmetry, self.anchor, q)])

    def stiffness(self, z: Array, part: Array | float = 1.0) -> Array:
        """What of the derivative of `residual` changes quickly, and is cheap: that of energies."""
        scene = with_part_of_weight(self.scene, part)
        unit = jnp.broadcast_to(scene.newton.force_scale, scene.start.q.shape)[:, None]
        by_shape = (elastic_stiffness(scene, self.split(z)[0]) / unit)[self.free][:, self.free]
        return jnp.pad(by_shape, (0, z.size - len(self.free)))

    def checked(self, found: Found) -> Found:
        """With the status of what has no balance at another time and place."""
        z, part, status, tries, size = found
        q, unknowns = self.split(z)
        rate = self.rate(part)
        motion = self.symmetry.motion(unknowns, rate)
        here = with_part_of_weight(self.scene, part)
        scene, q, motion = elsewhere(here, self.symmetry, q, motion, rate)
        force = moving_imbalance(scene, self.symmetry, q, motion, rate)
        left = largest((force / scene.newton.force_scale)[self.free])
        wrong = (status == Status.OK) & (left > ELSEWHERE)
        status = jnp.where(wrong, Status.NOT_STEADY, status).astype(jnp.int32)
        return z, part, status, tries, jnp.where(wrong, left, size)


def largest(residual: Array) -> Array:
    """The largest of the residuals; infinite if one is not a number."""
    worst = jnp.max(jnp.abs(residual))
    return jnp.where(jnp.isfinite(worst), worst, jnp.inf)


@pytree
class _Iterate:
    """Newton's method on the way.

    Attributes:
        z: unknowns, the best so far.
        residual: at z.
        size: the largest of them.
        ahead: unknowns that are looked at next.
        kept: what of the matrix is not found anew in every step.
        fresh: whether that was, for the step to `ahead`.
        count: how often it was so far.
        tries: steps so far.
        stalled: whether rounding leaves no smaller residual.
    """

    z: Array
    residual: Array
    size: Array
    ahead: Array
    kept: Array
    fresh: Array
    count: Array
    tries: Array
    stalled: Array


class Residual(Protocol):
    """What `newton` makes vanish, and a part of its derivative by the unknowns that is cheap."""

    def residual(self, z: Array, part: Array) -> Array: ...

    def stiffness(self, z: Array, part: Array) -> Array: ...


def newton(
    equations: Residual,
    guess: Array,
    part: Array,
    tolerance: Array,
) -> _Iterate:
    """Newton's method from a guess. What the fluid adds to the matrix is kept while it serves.

    A column for every unknown of how all drag changes with the shape is most of the work, and it
    changes little; what changes much, as rods are so stiff against stretching, is the stiffness.

    Full steps: for the same reason the size of the residual says little of the error, and a line
    search by it stalls.
    """

    def going(now: _Iterate) -> Array:
        unfinished = (now.size > tolerance) & ~now.stalled & jnp.isfinite(now.size)
        return (now.tries < 0) | unfinished & (now.count <= MOST_MATRICES) & (
            now.tries < MOST_TRIES
        )

    def step(now: _Iterate) -> _Iterate:
        residual = equations.residual(now.ahead, part)
        size = largest(residual)
        falls = size <= CONTRACTION * now.size
        taken = falls | now.fresh
        z, residual, size = (
            jnp.where(taken, new, old)
            for new, old in ((now.ahead, now.z), (residual, now.residual), (size, now.size))
        )
        stalled = taken & ~falls & (size <= ROUNDING * tolerance)
        first = now.tries < 0
        renew = (first | ~falls) & (size > tolerance) & ~stalled
        stiffness = equations.stiffness(z, part)

        def others() -> Array:
            return jacobian(lambda z: equations.residual(z, part), z) - stiffness

        kept = lax.cond(renew, others, lambda: now.kept)
        ahead = z - jnp.linalg.solve(kept + stiffness, residual)
        count = now.count + renew.astype(jnp.int32)
        return _Iterate(z, residual, size, ahead, kept, renew, count, now.tries + 1, stalled)

    zero, no = jnp.zeros((), jnp.int32), jnp.array(False)
    nothing = jnp.zeros((guess.size, guess.size))
    infinite = jnp.array(jnp.inf, float)
    start = _Iterate(guess, guess, infinite, guess, nothing, no, zero, zero - 1, no)
    return lax.while_loop(going, step, start)


@jax.jit
def _followed(scene: Scene, symmetry: Symmetry, guess: Array, guessed: Array) -> Found:
    """The steady state from a guess, or along growing rates of the motor, and whether it is one."""
    equations = Equations(scene, symmetry)
    tolerance = scene.newton.tolerance

    def going(carry):
        _, now, increment, *_ = carry
        return (now.part < 1.0) & (increment >= SMALLEST)

    def attempt(carry):
        before, now, increment, guessed, tries, _ = carry
        part = jnp.where(guessed, 1.0, jnp.minimum(now.part + increment, 1.0))
        known = now.part > before.part
        ahead = jnp.where(known, (part - now.part) / (now.part - before.part), 0.0)
        there = jnp.where(now.part > 0.0, now.z + ahead * (now.z - before.z), equations.rigid(part))
        there, anchor = jnp.where(guessed, guess, there), jnp.where(guessed, guess, now.z)
        found = newton(equations.near(anchor), there, part, tolerance)
        good = found.size <= ROUNDING * tolerance
        new, behind = jax.tree.map(
            lambda a, b: jnp.where(good, a, b), (_Point(found.z, part), now), (now, before)
        )
        # A guess that leads nowhere says nothing of the way from rest.
        shrink = jnp.where(guessed, 1.0, SHRINK)
        increment = increment * jnp.where(good, GROWTH, shrink)
        return behind, new, increment, jnp.array(False), tries + found.tries, found.size

    rest = _Point(equations.start(), jnp.zeros(()))
    zero = jnp.zeros((), jnp.int32)
    carry = (rest, rest, jnp.array(FIRST), guessed, zero, jnp.zeros(()))
    _, end, _, _, tries, size = lax.while_loop(going, attempt, carry)
    status = jnp.where(end.part >= 1.0, Status.OK, Status.MAX_ITERATIONS).astype(jnp.int32)
    return equations.checked((end.z, end.part, status, tries, size))


def steady(scene: Scene, guess: Steady | None = None) -> Steady:
    """The steady state of a robot with one flagellum, or of one filament on a fixed motor.

    A relative equilibrium: the shape turns and moves as a whole. It is found by Newton's method,
    from rest and along growing rates of the motor, and may be unstable (see `derjax.stability`).
    Differentiable in forward and reverse mode, to any order, by the implicit function theorem.

    Args:
        scene: with one motor of constant rate.
        guess: the steady state of a scene that differs a little: quicker. Where Newton's method
            finds nothing from there, it starts from rest.

    Returns:
        With a status; where there is no steady state at the motor's rate, the last one before it.

    Raises:
        InputError: the scene cannot swim steadily, such as one with several flagella.
    """
    symmetry = symmetry_of(scene)
    equations = Equations(scene, symmetry)
    # One program serves both: to compile it takes much longer than to run it.
    start = equations.start() if guess is None else unknowns_of(equations, guess)
    return _solved(scene, symmetry, start, jnp.array(guess is not None))


@jax.jit
def _solved(scene: Scene, symmetry: Symmetry, guess: Array, guessed: Array) -> Steady:
    found = _followed(*lax.stop_gradient((scene, symmetry, guess, guessed)))
    return solved_by(Equations(scene, symmetry), found)


def steady_as(scene: Scene, known: Steady) -> Steady:
    """A steady state that is known, as a function of the numbers of its scene.

    Nothing is solved for again: a program that only differentiates is short, and quick to compile.

    Args:
        scene: with the numbers of `known.scene`, which JAX may trace.
        known: its steady state.
    """
    known = lax.stop_gradient(known)
    symmetry = held_still(scene) if scene.motor is None else symmetry_of(scene)
    equations = Equations(scene, symmetry)
    z = unknowns_of(equations, known)
    found = z, jnp.ones(()), known.status, known.iterations, known.residual
    return solved_by(equations, found)


def solved_by(equations: Equations, solution: Found) -> Steady:
    """The steady state that has been found, with derivatives by the implicit function theorem."""
    found, part, status, tries, size = solution

    def linear(tangent: Any, y: Array) -> Array:
        return jnp.linalg.solve(jacobian(tangent, jnp.zeros_like(y)), y)

    here = equations.near(lax.stop_gradient(found))
    z = lax.custom_root(lambda z: here.residual(z, part), found, lambda _, there: there, linear)
    return _steady(equations, z, part, status, tries, size)


def unknowns_of(equations: Equations, known: Steady) -> Array:
    """The unknowns at a known steady state."""
    q = unwrapped(known.state)
    motion = known.motion
    symmetry = equations.symmetry
    unknowns = [motion.velocity] if symmetry.moves else []
    unknowns.append(symmetry.axes @ motion.rotation)
    return jnp.concatenate([q[equations.free], *unknowns])


def unwrapped(state: State) -> Array:
    """Degrees of freedom with the whole turns that have been taken out of angles."""
    n = state.q.size - state.turns.size
    return state.q.at[n:].add(2 * jnp.pi * state.turns)


def _steady(
    equations: Equations, z: Array, part: Array, status: Array, iterations: Array, size: Array
) -> Steady:
    scene, symmetry = equations.scene, equations.symmetry
    q, unknowns = equations.split(z)
    rate = equations.rate(part)
    motion = symmetry.motion(unknowns, rate)
    state = state_at(scene, q)
    velocity = rates(scene, symmetry, q, motion, rate)
    acceleration = rotating_acceleration(scene, motion, velocity)
    state = replace(state, velocity=velocity, acceleration=acceleration)
    return Steady(state, motion, rate, status, iterations, size, scene, symmetry)
