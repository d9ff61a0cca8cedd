"""Elastic rods against closed forms. Lengths are in units of the rod's, EI = 1."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    EA,
    EI,
    GJ,
    advance,
    cantilever,
    carry,
    elasticity,
    expand,
    gradient_at,
    held_dofs,
    order,
    point_force,
    rest,
    rotation,
    settled,
    straight_rod,
)
from scipy.linalg import null_space
from scipy.optimize import brentq

from derjax import Rod, Scene, State, Topology, chain, positions
from derjax.core.pytree import replace
from derjax.integrate.schemes.euler import euler
from derjax.rods.kinematics import angles, curvature, hinge_tangents, material_directors, tangents
from derjax.shapes import helix
from derjax.solve.newton import NewtonSettings
from derjax.terms import Gravity

SIZES = (12, 24)
"""Edges of a rod in tests of convergence: what is checked is the limit and the order."""
FINE = (24, 48)
"""The same for rings, whose buckling modes are shorter, and rods that bend sharply at a wall."""


def limit(values) -> np.ndarray:
    """Extrapolated to vanishing edge length from two meshes, for errors of second order."""
    coarse, fine = (np.asarray(v) for v in values)
    return fine + (fine - coarse) / 3


def loaded(rod: Rod, node: int = -1, force=(0.0, 0.0, 0.0)):
    """The terms of a rod with a force on one node; always the same compiled program."""
    return (*elasticity(rod), point_force(rod, node, force))


def energy(rod: Rod, state: State) -> float:
    return float(expand(rod, state, loaded(rod), state.q)[0])


@jax.jit
def measured_strains(rod: Rod, state: State) -> tuple[jax.Array, jax.Array]:
    """Integrated curvature (b, 2) and twist (b,) of the shape that `state` is in."""
    topology = rod.topology
    tangent = tangents(topology, positions(topology, state.q))
    m1, m2 = material_directors(state.reference_director, tangent, angles(topology, state.q))
    first, second = topology.hinge_edges.T
    t0, t1 = hinge_tangents(topology, tangent)
    kappa = curvature(t0, t1, (m1[first], m1[second]), (m2[first], m2[second]))
    theta = topology.hinge_signs * angles(topology, state.q)[topology.hinge_edges]
    return kappa, theta[:, 1] - theta[:, 0] + state.reference_twist


def ring(n: int, radius: float = 1.0) -> tuple[Rod, State]:
    """A naturally straight rod bent into a ring and joined to itself."""
    edges = tuple((i, (i + 1) % n) for i in range(n))
    hinges = tuple((i, (i + 1) % n) for i in range(n))
    phase = 2 * np.pi * np.arange(n) / n
    nodes = radius * np.stack([np.cos(phase), np.sin(phase), np.zeros(n)], axis=1)
    rod, state = rest(Topology(n, edges, hinges), nodes)
    return replace(rod, natural_curvature=jnp.zeros((n, 2))), state


# Energies: every half and every shared edge counted once -------------------------------------


def test_energy_of_a_bent_ring():
    radius = 0.4
    rings = [ring(n) for n in FINE]
    found = [float(expand(*r, elasticity(r[0]), r[1].q)[0]) for r in rings]
    exact = np.pi * EI  # of a ring of unit radius
    assert limit(found) == pytest.approx(exact, rel=1e-4)
    errors = np.array(found) / exact - 1
    assert order([1 / n for n in FINE], errors) == pytest.approx(2, abs=0.05)
    rod, state = ring(FINE[0], radius)
    smaller = float(expand(rod, state, elasticity(rod), state.q)[0])
    assert smaller == pytest.approx(found[0] / radius, rel=1e-12)


def test_energy_of_a_stretched_rod():
    rod, state = straight_rod(12)
    stretched = carry(rod, state, 1.01 * state.q)
    assert energy(rod, stretched) == pytest.approx(0.5 * EA * 0.01**2, rel=1e-10)


def test_energy_of_a_twisted_rod():
    """Half of GJ total^2 / length, between the middles of the first and the last edge."""
    n, total = 12, 11.0
    rod, state = straight_rod(n)
    state = carry(rod, state, state.q.at[-n:].set(total * jnp.linspace(0, 1, n)))
    assert energy(rod, state) == pytest.approx(0.5 * GJ * total**2 / (1 - 1 / n), rel=1e-12)


# Bending -------------------------------------------------------------------------------------


def tip(rod: Rod, state: State) -> tuple[float, float, float]:
    """How far the end of a cantilever came down and back, and its slope (rad)."""
    x = np.asarray(positions(rod.topology, state.q))
    edge = np.diff(x, axis=0)
    before, last = (np.arctan2(-e[2], e[0]) for e in edge[-2:])
    # from the slopes 3/2 and 1/2 edges before the end, where the curvature vanishes
    return -x[-1, 2], 1 - x[-1, 0], last + (last - before) / 8


def test_small_deflection_is_that_of_euler_and_bernoulli():
    """PL^3 / 3EI and PL^2 / 2EI."""
    load = 1e-3
    found = []
    for n in SIZES:
        rod, state, held = cantilever(n)
        found.append(tip(rod, settled(rod, state, loaded(rod, -1, [0, 0, -load]), held)))
    assert limit(found)[[0, 2]] == pytest.approx([load / 3, load / 2], rel=5e-5)
    errors = [drop / (load / 3) - 1 for drop, _, _ in found]
    assert order([1 / n for n in SIZES], errors) == pytest.approx(2, abs=0.1)


# Tip load PL^2/EI: drop and retreat of the tip (in units of L), its slope (rad). From elliptic
# integrals; at 1 the first two agree with K. Mattiasson, Int. J. Numer. Methods Eng. 17, 145
# (1981).
ELASTICA = {
    0.1: (0.033295, 0.000665, 0.049954),
    0.5: (0.162144, 0.015919, 0.244534),
    1.0: (0.301721, 0.056433, 0.461352),
    2.0: (0.493457, 0.160642, 0.781750),
    3.0: (0.603253, 0.254420, 0.986017),
    5.0: (0.713792, 0.387628, 1.215368),
    10.0: (0.810609, 0.554996, 1.430286),
}


def test_large_deflections_are_those_of_the_elastica():
    found = []
    for n in FINE:
        rod, state, held = cantilever(n)
        rows = []
        for load in ELASTICA:
            state = settled(rod, state, loaded(rod, -1, [0, 0, -load]), held)
            rows.append(tip(rod, state))
        found.append(rows)
    exact = np.array(list(ELASTICA.values()))
    assert np.abs(found[1] - exact).max() < 2e-3
    np.testing.assert_allclose(limit(found), exact, atol=5e-5)


# alpha = (weight per length) L^3 / EI: tip position x / L, drop y / L, slope (rad); from the
# boundary value problem EI theta'' = -w (L - s) cos theta, solved to 1e-10.
HEAVY = {
    1.0: (0.991246, 0.123471, 0.165116),
    5.0: (0.846657, 0.495905, 0.697005),
    10.0: (0.656354, 0.700200, 1.052643),
    39.24: (0.287124, 0.893379, 1.496471),
}


def weight(rod: Rod, alpha: float) -> Gravity:
    """Each node weighs what the length of rod that it stands for weighs."""
    n = rod.topology.n_edges
    length = jnp.full(n + 1, rod.rest_length[0]).at[-1].mul(0.5)
    return Gravity(length, jnp.array([0.0, 0.0, -alpha]))


def test_heavy_cantilever():
    found = []
    for n in FINE:
        rod, state, held = cantilever(n)
        rows = []
        for alpha in HEAVY:
            state = settled(rod, state, (*elasticity(rod), weight(rod, alpha)), held)
            drop, retreat, slope = tip(rod, state)
            rows.append((1 - retreat, drop, slope))
        found.append(rows)
    exact = np.array(list(HEAVY.values()))
    assert np.abs(found[1] - exact).max() < 5e-3
    np.testing.assert_allclose(limit(found), exact, atol=3e-4)


def test_a_step_without_dissipation_lands_on_the_equilibrium():
    """derjax's own Newton solver, with what is held given by the topology."""
    rod, state, held = cantilever(12)
    terms = (*elasticity(rod, ea=1e3), weight(rod, 1.0))
    ones = jnp.ones(rod.topology.n_dofs)
    settings = NewtonSettings(tolerance=jnp.asarray(1e-8), force_scale=ones)
    scene = Scene(rod, terms, None, settings, jnp.ones(()), euler)
    new, info = advance(scene, state)
    assert info.status == 0
    np.testing.assert_allclose(new.q, settled(rod, state, terms, held).q, atol=1e-9)
    assert not np.any(new.q[np.array(held)] - state.q[np.array(held)])


def test_deflection_does_not_depend_on_the_direction_of_the_load():
    """An isotropic rod bends the same way across any direction, whatever its directors."""
    rod, state, held = cantilever(12)
    drops = []
    for angle in (0.0, 0.4, 2.0):
        across = np.array([0.0, np.sin(angle), -np.cos(angle)])
        bent = settled(rod, state, loaded(rod, -1, 3.0 * across), held)
        drops.append(float(positions(rod.topology, bent.q)[-1] @ across))
    assert drops == pytest.approx([drops[0]] * 3, rel=1e-9)


def smallest_stiffness(n: int, load: float) -> float:
    """Least eigenvalue of the Hessian of a straight cantilever that is pressed at its tip."""
    rod, state, held = cantilever(n)
    along = slice(0, 3 * rod.topology.n_nodes, 3)
    x = np.asarray(state.q[along])
    q = state.q.at[along].set(x[1] + (1 - load / EA) * (x - x[1]))
    q = q.at[0].set(x[0])
    state = carry(rod, state, q)
    free = np.setdiff1d(np.arange(len(q)), held)
    _, gradient, hessian = expand(rod, state, loaded(rod, -1, [-load, 0, 0]), state.q)
    assert np.abs(gradient[free]).max() < 1e-6 * load  # it is an equilibrium
    return float(np.linalg.eigvalsh(np.asarray(hessian)[free][:, free])[0])


def test_euler_buckling():
    """A clamped column gives way at pi^2 EI / 4 L^2."""
    exact = np.pi**2 / 4
    found = [brentq(lambda p, n=n: smallest_stiffness(n, p), 2.0, 3.0, xtol=1e-8) for n in SIZES]
    assert limit(found) == pytest.approx(exact, rel=1e-4)
    errors = np.abs(np.array(found) / exact - 1)
    assert order([1 / n for n in SIZES], errors) == pytest.approx(2, abs=0.1)


# Natural shapes ------------------------------------------------------------------------------


@pytest.mark.parametrize("handedness", ["left", "right"])
def test_a_helix_at_its_natural_shape_is_free_of_force(handedness):
    rod, state = rest(chain(25), helix(0.1, 0.6, 1.0, 24, handedness))
    assert np.abs(rod.natural_curvature).max() > 0.1
    soft = (*elasticity(rod, ea=1.0), point_force(rod))
    # strains of machine epsilon: forces of a few epsilon EI / l^2, with l = 1/19
    np.testing.assert_allclose(gradient_at(rod, state, soft), 0.0, atol=1e-12)
    # nor does a rigid motion, done bit by bit, bring forces
    moved = state
    for _ in range(5):
        x = positions(rod.topology, moved.q) @ rotation([1, 2, 3], 0.5).T + jnp.ones(3)
        moved = carry(rod, moved, moved.q.at[:75].set(x.ravel()))
    # transport in time leaves out each edge's spin about itself; the angles have to find it
    found = settled(rod, moved, soft, held_dofs(rod.topology, range(25), ()))
    np.testing.assert_allclose(gradient_at(rod, found, soft), 0.0, atol=1e-10)
    assert energy(rod, found) < 1e-16


def test_a_bent_helix_goes_back_to_its_natural_shape(rng):
    nodes = helix(0.1, 0.6, 1.0, 24, "left")
    rod, natural = rest(chain(25), nodes)
    held = held_dofs(rod.topology, (0, 1), (0,))
    push = 0.01 * rng.standard_normal(rod.topology.n_dofs)
    push[np.array(held)] = 0.0
    state = settled(rod, carry(rod, natural, natural.q + push), loaded(rod), held)
    np.testing.assert_allclose(positions(rod.topology, state.q), nodes, atol=1e-9)


# Twisting ------------------------------------------------------------------------------------


@pytest.mark.parametrize("total", [0.5, 4.0, -20.0])
def test_a_twisted_rod_resists_with_uniform_twist(total):
    n = 12
    rod, state = straight_rod(n)
    held = held_dofs(rod.topology, (0, 1, n - 1, n), (0, n - 1))
    for part in np.linspace(0, total, 8)[1:]:
        angle = part - 2 * np.pi * state.turns[-1]  # whole turns are counted apart
        state = settled(rod, replace(state, q=state.q.at[-1].set(angle)), loaded(rod), held)
    _, twist = measured_strains(rod, state)
    np.testing.assert_allclose(twist, total / (n - 1), rtol=1e-9)
    torque = gradient_at(rod, state, loaded(rod))[-n:]
    expected = GJ * total / (1 - 1 / n)
    np.testing.assert_allclose(torque[[0, -1]], [-expected, expected], rtol=1e-9)
    np.testing.assert_allclose(torque[1:-1], 0.0, atol=1e-9)


def test_reference_twist_keeps_counting_past_half_a_turn():
    """The tangent of the second of two edges goes around a circle, again and again.

    Its director, transported in time, comes back turned by the solid angle that the tangent
    enclosed, 2 pi (1 - cos tilt). The transport from the first tangent to it has no such
    memory, and where the first tangent is inside the circle, that is all.
    """
    tilt, rounds, n = 1.2, 3, 200
    rod, state = straight_rod(2)
    solid_angle = 2 * np.pi * (1 - np.cos(tilt))

    def pointed(phase):
        tangent = [np.cos(tilt), np.sin(tilt) * jnp.cos(phase), np.sin(tilt) * jnp.sin(phase)]
        return state.q.at[6:9].set(state.q[3:6] + 0.5 * jnp.array(tangent))

    @jax.jit
    def go_round(moving):
        def one(k, moving):
            return carry(rod, moving, pointed(2 * jnp.pi * (k + 1) / n))

        return jax.lax.fori_loop(0, rounds * n, one, moving)

    moving = go_round(carry(rod, state, pointed(0.0)))
    # polygons enclose less than circles do, by a part of order 1 / n^2
    assert abs(float(moving.reference_twist[0])) > 2 * np.pi
    assert abs(float(moving.reference_twist[0])) == pytest.approx(rounds * solid_angle, rel=1e-3)


def critical_twist(n: int) -> float:
    """The twist (rad) at which a twisted ring stops being flat."""
    rod, state = ring(n)
    flat = np.asarray(positions(rod.topology, state.q))
    tangent = np.asarray(tangents(rod.topology, flat))
    rigid = np.zeros((4 * n, 7))
    for k, axis in enumerate(np.eye(3)):
        rigid[: 3 * n, k] = np.tile(axis, n)
        rigid[: 3 * n, 3 + k] = np.cross(axis, flat).ravel()
        rigid[3 * n :, 3 + k] = tangent @ axis
    rigid[3 * n :, 6] = 1.0  # a naturally straight, isotropic rod may also roll in itself
    deforming = null_space(rigid.T)

    def stiffness(total: float) -> float:
        # of a rod that is naturally twisted the other way, and joined without twist
        strained = replace(rod, natural_twist=rod.natural_twist - total / n)
        _, gradient, hessian = expand(strained, state, elasticity(rod, ea=1e5), state.q)
        assert np.abs(gradient).max() < 1e-8  # it is an equilibrium
        assert np.abs(hessian @ rigid).max() < 1e-6
        return np.linalg.eigvalsh(deforming.T @ np.asarray(hessian) @ deforming)[0]

    return brentq(stiffness, 12.0, 20.0, xtol=1e-5)


def test_a_twisted_ring_buckles_as_michell_found():
    """At 2 pi sqrt(3) EI / GJ (J. H. Michell, 1889; E. E. Zajac, 1962)."""
    exact = 2 * np.pi * np.sqrt(3) * EI / GJ
    found = [critical_twist(n) for n in FINE]
    assert found[1] == pytest.approx(exact, rel=0.02)
    assert limit(found) == pytest.approx(exact, rel=1e-3)


# Motors --------------------------------------------------------------------------------------


def test_thousands_of_turns_of_a_motor_leave_strains_and_frames_as_they_are():
    """Angles and their counterparts are wrapped together; the same strain to round-off."""
    n, edges, steps = 7, 6, 12_000
    nodes = np.array(helix(0.1, 0.6, 1.0, edges, "left"))
    rod, state = rest(chain(n, motors=(1,)), nodes)
    angle = np.linspace(0.0, 0.3, edges)
    rates = np.array([-0.7, -0.7, 2.0, 2.0, 2.0, 2.0])  # rad per step, each side of the motor
    state = carry(rod, state, state.q.at[-edges:].set(angle))

    def motor_strains(state):
        kappa, twist = measured_strains(rod, state)
        return np.column_stack([kappa, twist - rod.natural_twist]) - np.outer(
            np.arange(edges - 1) == 1, [0, 0, 1]
        ) * float(state.motor_angle[0])

    @jax.jit
    def turn(state):
        def one(_, state):
            state = replace(state, motor_angle=state.motor_angle + rates[2] - rates[1])
            return carry(rod, state, state.q.at[-edges:].add(rates))

        return jax.lax.fori_loop(0, steps, one, state)

    before, state = motor_strains(state), turn(state)
    assert steps * (rates[2] - rates[1]) > 2 * np.pi * 5000
    # on either side of the motor the material frames have turned alike
    after = motor_strains(state)
    np.testing.assert_allclose(after[:, 2], before[:, 2], atol=1e-10)
    size = np.linalg.norm(before[:, :2], axis=1)
    np.testing.assert_allclose(np.linalg.norm(after[2:, :2], axis=1), size[2:], atol=1e-10)
    bounded = [*angles(rod.topology, state.q), *state.motor_angle]
    assert np.abs(bounded).max() <= np.pi
    total = angles(rod.topology, state.q) + 2 * np.pi * state.turns
    np.testing.assert_allclose(total, angle + steps * rates, atol=1e-8)
    director = np.asarray(state.reference_director)
    tangent = np.asarray(tangents(rod.topology, positions(rod.topology, state.q)))
    np.testing.assert_allclose(np.sum(director**2, axis=1), 1.0, atol=4e-15)
    np.testing.assert_allclose(np.sum(director * tangent, axis=1), 0.0, atol=4e-15)
