"""What several test files need: rods with ends held, statics, and finite differences."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from derjax import Rod, Scene, State, Topology, at_rest, chain
from derjax.core.pytree import pytree, replace
from derjax.integrate.step import predict
from derjax.rods.rod import no_history, transport_frames
from derjax.solve.newton import NewtonInfo
from derjax.solve.potential import Potential, assemble
from derjax.terms import Bend, Gravity, Stage, Stretch, Term, Twist
from derjax.terms.term import contributions

EI = 1.0
GJ = 0.7
EA = 1.0e7
"""Stiff enough to count as inextensible: strains below 1e-6 of the bending ones."""


rest = jax.jit(at_rest, static_argnums=0)
"""`derjax.at_rest`, compiled as a whole: quicker than operation by operation."""


def straight_rod(n_edges: int) -> tuple[Rod, State]:
    """A straight rod of unit length along x, free at both ends."""
    nodes = np.zeros((n_edges + 1, 3))
    nodes[:, 0] = np.linspace(0, 1, n_edges + 1)
    return rest(chain(n_edges + 1), nodes)


def cantilever(n_edges: int) -> tuple[Rod, State, tuple[int, ...]]:
    """A straight rod along x that sticks out of a wall at x = 0 by its unit length.

    Also what the wall holds: the first edge, which comes before the `n_edges` that stick out.
    """
    nodes = np.zeros((n_edges + 2, 3))
    nodes[:, 0] = (np.arange(n_edges + 2) - 1.0) / n_edges
    held = held_dofs(chain(n_edges + 2), (0, 1), (0,))
    return *rest(chain(n_edges + 2, fixed_dofs=held), nodes), held


def held_dofs(topology: Topology, nodes: Sequence[int], edges: Sequence[int]) -> tuple[int, ...]:
    """Degrees of freedom of the positions of some nodes and the angles of some edges."""
    dofs = [*topology.node_dofs(nodes).ravel(), *topology.edge_dofs(edges)]
    return tuple(int(i) for i in dofs)


def elasticity(rod: Rod, ea: float = EA, ei: float = EI, gj: float = GJ) -> tuple[Term, ...]:
    """Stretching, bending and twisting of a uniform rod."""
    n_edges, n_hinges = rod.topology.n_edges, len(rod.topology.hinges)
    return (
        Stretch(jnp.full(n_edges, ea)),
        Bend(jnp.full(n_hinges, ei)),
        Twist(jnp.full(n_hinges, gj)),
    )


def point_force(rod: Rod, node: int = -1, force: Any = (0.0, 0.0, 0.0)) -> Gravity:
    """A dead force (N) on one node."""
    mass = jnp.zeros(rod.topology.n_nodes).at[node].set(1.0)
    return Gravity(mass, jnp.asarray(force, dtype=float))


def potential(
    rod: Rod, state: State, terms: tuple[Term, ...], step: float | Array = 1.0
) -> Potential:
    """The incremental potential of a step of length `step` (s) without motion of the motors."""
    return assemble(contributions(terms, rod, state, stage_from(state, step)))


def stage_from(state: State, length: float | Array) -> Stage:
    """A step of implicit Euler of some length (s) in which the motors stand still."""
    length = jnp.asarray(length)
    return Stage(length, state.time + length, state.motor_angle)


def share(term: Term, rod: Rod, state: State, length: float | Array) -> Any:
    """What one term contributes to a step of some length (s) in which the rod stands still."""
    return contributions([term], rod, state, stage_from(state, length))[0]


def advance(scene: Scene, state: State) -> tuple[State, NewtonInfo]:
    """One step of the scene's scheme and length."""
    step = scene.scheme(scene, state, scene.step_length)
    return step.state, step.info


@pytree
class Prepared(Term):
    """A term with what it has prepared for one step."""

    term: Term
    cache: Any

    def contribution(self, rod: Rod, state: State, stage: Stage, cache: Any) -> Any:
        return self.term.contribution(rod, state, stage, self.cache)


def acting(scene: Scene, state: State, kind: type) -> tuple[Term, ...]:
    """The one term of some kind, as it acts in a step of implicit Euler from `state`."""
    terms = tuple(term for term in scene.terms if isinstance(term, kind))
    assert len(terms) == 1
    h = scene.step_length
    found = predict(replace(scene, terms=terms), state, 0.5 * h, h)
    return tuple(Prepared(term, found.cache(term, scene.rod, state)) for term in terms)


@jax.jit
def expand(rod: Rod, state: State, terms: tuple[Term, ...], q: Array) -> tuple[Array, Array, Array]:
    """Value, gradient and Hessian at `q` of the step that starts at `state`."""
    total = potential(rod, state, terms)
    return total.value(q), total.gradient(q), total.hessian(q)


def gradient_at(rod: Rod, state: State, terms: tuple[Term, ...]) -> np.ndarray:
    """Gradient of the potential at the state itself."""
    return np.asarray(expand(rod, state, terms, state.q)[1])


def hessian_at(rod: Rod, state: State, terms: tuple[Term, ...]) -> np.ndarray:
    """Hessian of the potential at the state itself."""
    return np.asarray(expand(rod, state, terms, state.q)[2])


carry = jax.jit(transport_frames)


def settled(rod: Rod, state: State, terms: tuple[Term, ...], held: tuple[int, ...] = ()) -> State:
    """The equilibrium near `state` of elastic forces and dead loads.

    A plain Newton method with a line search: quick to compile (rods that differ in what is
    held share one program), and independent of derjax's own.
    """
    free = np.setdiff1d(np.arange(rod.topology.n_dofs), held)
    q = np.array(state.q)
    value, gradient, hessian = expand(rod, state, terms, q)
    for _ in range(200):
        step = np.zeros_like(q)
        eigenvalues, modes = np.linalg.eigh(np.asarray(hessian)[free][:, free])
        step[free] = -modes @ (modes.T @ np.asarray(gradient)[free] / np.abs(eigenvalues))
        decrease = -float(step @ gradient)
        length = 1.0
        while length > 1e-3:
            trial = expand(rod, state, terms, q + length * step)
            if trial[0] <= value - 0.1 * length * decrease + 1e-13 * abs(value):
                break
            length /= 2
        q, (value, gradient, hessian) = q + length * step, trial
        if np.abs(step).max() < 1e-10:
            return carry(rod, state, q)
    raise AssertionError(f"no equilibrium: the last step was {np.abs(step).max():.1e}")


def at_speed(state: State, velocity: Array) -> State:
    """The state with some velocity (m/s, rad/s) that it is expected to keep."""
    return replace(
        state,
        velocity=velocity,
        acceleration=jnp.zeros_like(velocity),
        history=no_history(state.q),
    )


def order(sizes: list[float], errors: list[float]) -> float:
    """The slope of log(error) against log(size), by least squares."""
    return float(np.polyfit(np.log(sizes), np.log(errors), 1)[0])


def finite_difference_jvp(
    function: Callable[[Any], Array], at: Any, along: Any, step: float = 1e-4
) -> Array:
    """Derivative of `function` in a direction, by central differences of fourth order."""

    def value(s: float) -> Array:
        return function(jax.tree.map(lambda x, d: x + s * step * d, at, along))

    return (8.0 * (value(1.0) - value(-1.0)) - (value(2.0) - value(-2.0))) / (12.0 * step)


def rotation(axis: Any, angle: float) -> Float[Array, "3 3"]:
    """The matrix that turns vectors by `angle` (rad) about `axis`."""
    x, y, z = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return jnp.asarray(np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k)


def perturbed(rod: Rod, state: State, rng: np.random.Generator, size: float) -> State:
    """`state` after a random displacement of `size` edge lengths and as many radians."""
    scale = np.full(rod.topology.n_dofs, size)
    scale[: 3 * rod.topology.n_nodes] *= float(jnp.min(rod.rest_length))
    return transport_frames(rod, state, state.q + scale * rng.standard_normal(len(scale)))
