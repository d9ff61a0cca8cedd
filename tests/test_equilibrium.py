"""Rods at rest under loads: closed forms, buckling as a change of stability, derivatives."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from jaxtyping import Array, Float

import derjax as dj
from derjax.core.pytree import replace

LENGTH, RADIUS, N = 0.4, 4e-3, 33
VISCOSITY = jnp.array([1.3, 2.1])
"""N s/m^2: drag along and across, per length and velocity."""

ROD = dj.Rod.straight(N + 1, LENGTH * N / (N - 1), RADIUS, fixed="start")
"""The first edge is held, and `LENGTH` sticks out."""

E = 1e6
EI, EA = E * np.pi * RADIUS**4 / 4, E * np.pi * RADIUS**2


def scene_with(*terms: dj.Term) -> dj.Scene:
    n_edges, n_hinges = ROD.topology.n_edges, len(ROD.topology.hinges)
    elastic = (
        dj.Stretch(jnp.full(n_edges, EA)),
        dj.Bend(jnp.full(n_hinges, EI)),
        dj.Twist(jnp.full(n_hinges, EI)),
    )
    drag = dj.ResistiveDrag(*VISCOSITY), dj.SpinDrag(jnp.asarray(1e-4))
    return dj.Scene(
        rod=ROD,
        terms=(*elastic, *drag, *terms),
        motor=None,
        newton=dj.NewtonSettings(jnp.asarray(1e-10), jnp.asarray(EI / LENGTH**2)),
        step_length=jnp.asarray(0.01),
        scheme=dj.euler,
        initial=ROD.at_rest(),
    )


def heavy(load: Array) -> dj.Scene:
    """A weight per length of `load` EI / LENGTH^3, on the half edges beside every node."""
    ends = (
        jnp.concatenate([ROD.rest_length, jnp.zeros(1)]),
        jnp.roll(jnp.concatenate([ROD.rest_length, jnp.zeros(1)]), 1),
    )
    weight = dj.Gravity(0.5 * (ends[0] + ends[1]), load * EI / LENGTH**3)
    return scene_with(weight)


@jax.jit
def resting(load: Array) -> dj.Steady:
    return dj.equilibrium(heavy(load))


@pytest.mark.slow
def test_a_heavy_rod_hangs_like_the_elastica():
    """x, y and angle of the tip at weights of 1, 5 and 10 EI / L^3 per length."""
    for load, x, y in (
        (1.0, 0.991246, 0.123471),
        (5.0, 0.846657, 0.495905),
        (10.0, 0.656354, 0.7002),
    ):
        state = resting(jnp.array([0.0, 0.0, -load]))
        state.raise_if_failed()
        tip = np.asarray(state.positions)[-1] - np.array([LENGTH / (N - 1), 0.0, 0.0])
        np.testing.assert_allclose(tip[[0, 2]] / LENGTH, [x, -y], atol=5e-4)
        assert not tip[1]


def tip(load: Array) -> Array:
    return resting(load).positions[-1]


def test_derivatives_by_the_load_agree_with_differences_in_both_modes():
    at, along, h = jnp.array([0.3, 0.2, -8.0]), jnp.array([0.5, -0.3, 1.0]), 1e-4
    forward, reverse = jax.jit(jax.jacfwd(tip))(at), jax.jit(jax.jacrev(tip))(at)
    difference = (tip(at + h * along) - tip(at - h * along)) / (2 * h)
    size = np.abs(difference).max()
    np.testing.assert_allclose(forward @ along, difference, atol=1e-6 * size)
    np.testing.assert_allclose(reverse, forward, atol=1e-9 * size)


def test_a_column_buckles_under_its_weight_as_greenhill_found():
    """At 7.8373 EI / L^3, where the straight column loses its stability."""
    loads = np.array([7.6, 8.0])
    growth = [dj.stability(resting(jnp.array([-load, 0.0, 0.0]))).growth_rate for load in loads]
    assert growth[0] < 0.0 < growth[1]
    threshold = loads[0] - growth[0] * np.diff(loads)[0] / (growth[1] - growth[0])
    assert threshold == pytest.approx(7.8373, rel=2e-3)


def test_a_column_that_is_pushed_a_little_falls_to_where_it_is_stable():
    state = resting(jnp.array([-9.0, 0.0, 1e-2]))
    state.raise_if_failed()
    assert float(state.positions[-1, 2]) > 0.3 * LENGTH
    assert dj.stability(state).is_stable
    # Newton's method from near the straight column stays with that, and stability says so.
    straight = dj.equilibrium(heavy(jnp.array([-9.0, 0.0, 0.0])), guess=resting(jnp.zeros(3)))
    straight.raise_if_failed()
    assert not dj.stability(straight).is_stable


def test_a_straight_rod_relaxes_at_the_rates_of_its_modes():
    """b^4 EI / (drag across L^4) with b^4 = 12.3624 and 485.519, in both planes."""
    found = dj.stability(resting(jnp.zeros(3))).eigenvalues[:4]
    rates = np.repeat([12.3624, 485.519], 2) * EI / (float(VISCOSITY[1]) * LENGTH**4)
    np.testing.assert_allclose(found.imag, 0.0, atol=1e-6 * rates[0])
    np.testing.assert_allclose(-found.real, rates, rtol=2e-2)


@pytest.mark.slow
def test_a_heavy_rod_in_a_thin_fluid_swings():
    """m lambda^2 + c lambda + k = 0 for each of its modes, with k = b^4 EI / L^4."""
    ends = jnp.concatenate([ROD.rest_length, jnp.zeros(1)])
    density = 40.0  # kg/m: as much as makes the slowest mode swing
    mass = density * 0.5 * (ends + jnp.roll(ends, 1))
    inertia = dj.Inertia(jnp.concatenate([jnp.repeat(mass, 3), jnp.zeros(N)]))
    found = dj.stability(dj.equilibrium(scene_with(inertia)))
    drag, stiffness = float(VISCOSITY[1]), np.array([12.3624, 485.519]) * EI / LENGTH**4
    swings = np.sqrt(4 * density * stiffness - drag**2) / (2 * density)
    assert np.all(drag**2 < 4 * density * stiffness)
    values = found.eigenvalues
    for swing in swings:
        pair = values[np.argsort(np.abs(values.imag - swing))[:2]]  # in both planes
        np.testing.assert_allclose(pair.imag, swing, rtol=2e-2)
        np.testing.assert_allclose(pair.real, -drag / (2 * density), rtol=2e-2)


@dj.pytree
class Tip(dj.Term):
    """Forces (N) on the last node.

    Attributes:
        along: a dead load along x.
        against: one against the direction of the last edge, whatever that is.
    """

    along: Float[Array, ""]
    against: Float[Array, ""]

    def contribution(self, rod, state, stage, cache):
        x = dj.positions(rod.topology, state.q)
        edge = x[-1] - x[-2]
        dofs = rod.topology.node_dofs([rod.topology.n_nodes - 1]).ravel()
        push = self.along * jnp.array([1.0, 0.0, 0.0])
        push = push - self.against * edge / jnp.linalg.norm(edge)
        return dj.Load(jnp.zeros_like(state.q).at[dofs].set(push))


@jax.jit
def pushed(along: Array | float, against: Array | float) -> dj.Steady:
    """With loads in units of EI / LENGTH^2."""
    loads = (jnp.asarray(load * EI / LENGTH**2) for load in (along, against))
    return dj.equilibrium(scene_with(Tip(*loads)))


def crossing(states: Sequence[dj.Steady], values: np.ndarray, oscillates: bool = False) -> float:
    """Where the growth rate vanishes between the values of two states, the first one stable."""
    growth = []
    for state in states:
        state.raise_if_failed()
        modes = dj.stability(state)
        assert (abs(modes.eigenvalues[0].imag) > abs(modes.growth_rate)) == oscillates
        growth.append(modes.growth_rate)
    assert growth[0] < 0.0 < growth[1]
    return float(values[0] - growth[0] * np.diff(values)[0] / (growth[1] - growth[0]))


@pytest.mark.slow
def test_a_column_buckles_under_a_load_as_euler_found():
    """At pi^2 / 4 EI / L^2, clamped and free."""
    loads = np.pi**2 / 4 * np.array([0.98, 1.02])
    found = crossing([pushed(-load, 0.0) for load in loads], loads)
    assert found == pytest.approx(np.pi**2 / 4, rel=1e-3)


def ring(twist: Array) -> dj.Scene:
    """A straight rod bent into a ring whose ends, held side by side, are turned by `twist`.

    Opposite of them a node is held in the plane: else the whole ring could turn about the ends.
    """
    free = N - 2
    topology = dj.Rod.straight(N + 1, LENGTH, RADIUS, fixed="both").topology
    opposite = 3 * (1 + free // 2) + 2
    topology = replace(topology, fixed_dofs=tuple(sorted({*topology.fixed_dofs, opposite})))
    angle, radius = 2 * np.pi * np.arange(free + 1) / free, LENGTH / (2 * np.pi)
    round_ = radius * np.stack([np.sin(angle), 1 - np.cos(angle), 0.0 * angle], axis=1)
    end = np.array([[LENGTH / free, 0.0, 0.0]])
    rod, state = dj.at_rest(topology, np.concatenate([-end, round_, end]))
    rod = replace(rod, natural_curvature=jnp.zeros_like(rod.natural_curvature))
    along = np.concatenate([[0.0], (np.arange(free) + 0.5) / free, [1.0]])
    turned = state.q.at[3 * (N + 1) :].set(twist * jnp.asarray(along))
    return replace(scene_with(), rod=rod, initial=replace(state, q=turned))


@jax.jit
def twisted(twist: Array) -> dj.Steady:
    return dj.equilibrium(ring(twist))


@pytest.mark.slow
def test_a_twisted_ring_buckles_as_michell_found():
    """At 2 pi sqrt(3) EI / GJ (Michell 1889, Zajac 1962), with EI = GJ here.

    Where the slowest mode stops to decay; the 31 edges of the ring make that 1 % more.
    """
    expected = 2 * np.pi * np.sqrt(3.0)
    twists = expected * np.array([0.965, 0.985])
    growth = [dj.stability(twisted(jnp.asarray(twist))).growth_rate for twist in twists]
    assert growth[0] < growth[1] < 0.0
    found = twists[1] - growth[1] * np.diff(twists)[0] / (growth[1] - growth[0])
    assert found == pytest.approx(expected, rel=1.5e-2)


def flutter() -> float:
    """F L^2 / EI at which y'''' + F y'' = -lambda y, clamped and free, has Re(lambda) = 0."""

    def determinant(load: float, rate: complex) -> complex:
        roots = np.roots([1.0, 0.0, load, 0.0, rate])
        rows = [roots**0, roots, roots**2 * np.exp(roots), roots**3 * np.exp(roots)]
        vandermonde = np.prod([roots[i] - roots[j] for i in range(4) for j in range(i)])
        return complex(np.linalg.det(np.array(rows)) / vandermonde)

    def equations(unknowns: np.ndarray) -> list[float]:
        value = determinant(unknowns[0], 1j * unknowns[1])
        return [value.real, value.imag]

    return float(scipy.optimize.fsolve(equations, [75.0, 200.0])[0])


@pytest.mark.slow
def test_a_follower_force_makes_a_clamped_filament_flutter():
    """A pair of eigenvalues crosses the imaginary axis."""
    expected = flutter()
    assert expected == pytest.approx(37.7, abs=0.1)
    loads = expected * np.array([0.97, 1.03])
    found = crossing([pushed(0.0, load) for load in loads], loads, oscillates=True)
    assert found == pytest.approx(expected, rel=1e-2)


@pytest.mark.slow
def test_operators_are_derivatives_of_the_forces(rng):
    scene = heavy(jnp.array([0.0, 0.0, -5.0]))
    state = resting(jnp.array([0.0, 0.0, -5.0])).state
    operators = dj.operators(scene, state)
    stiffness, drag = np.asarray(operators.stiffness), np.asarray(operators.drag)
    n = 3 * ROD.topology.n_nodes
    hessian = np.asarray(dj.potential(scene, state, 1e9).hessian(state.q))
    np.testing.assert_allclose(stiffness, hessian, atol=1e-7 * np.abs(hessian).max())
    velocity = rng.standard_normal(ROD.topology.n_dofs)
    forces = dj.forces(scene, replace(state, velocity=jnp.asarray(velocity)))
    np.testing.assert_allclose(-drag[:n] @ velocity, forces["ResistiveDrag"].ravel(), rtol=1e-9)
    assert not np.any(operators.mass)
    assert set(operators.free) == set(range(ROD.topology.n_dofs)) - set(ROD.topology.fixed_dofs)


def test_a_rod_that_nothing_holds_has_no_equilibrium():
    rod = dj.Rod.straight(9, LENGTH, RADIUS)
    scene = replace(scene_with(), rod=rod, initial=rod.at_rest())
    with pytest.raises(dj.InputError, match="nothing holds the rod"):
        dj.equilibrium(scene)
