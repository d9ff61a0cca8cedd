"""Friction: slip of surfaces, Coulomb's law on a slope, and a rod that is pulled around others."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import advance, at_speed, elasticity, held_dofs, rest, rotation, share

from derjax import Scene, State, Topology, positions, roll_frames
from derjax.core.pytree import Indices, replace
from derjax.core.status import Status
from derjax.integrate.schemes.euler import euler
from derjax.rods.kinematics import tangents
from derjax.solve.newton import NewtonSettings
from derjax.terms import Contact, Friction, Gravity, Inertia, Stretch
from derjax.terms.contact.friction import FrictionDissipation, SlipData, slip
from derjax.terms.contact.repulsion import RAMP, SOFTNESS

# One pair -------------------------------------------------------------------------------------

DIAMETER = 0.1
GAP = 0.0994

CROSS = np.array([[-1.0, 0, GAP], [1.0, 0, GAP], [0, -0.6, 0], [0, 0.6, 0]])
"""The first edge along x, above the second along y."""

slip_of = jax.jit(jax.vmap(lambda x: slip(x.ravel(), jnp.asarray(DIAMETER))[0]))


def skew_pairs(rng: np.random.Generator, n: int = 200) -> np.ndarray:
    """(n, 4, 3) edges that touch, at any angle, end to end and side by side too."""
    pairs = []
    for k in range(n):
        angle = [0.0, 1e-6, 0.3, 1.5, np.pi][k % 5]
        x = np.array([[0, 0, 0], [1.0, 0, 0], [0, 0, 0], [np.cos(angle), np.sin(angle), 0]])
        x[2:] += [rng.uniform(-0.9, 0.9), 0, rng.uniform(0.9, 1) * DIAMETER]
        pairs.append(x @ np.asarray(rotation(rng.standard_normal(3), rng.uniform(0, 3))).T)
    return np.array(pairs)


def moved(pair: np.ndarray, first: Any, second: Any) -> np.ndarray:
    """(14,) displacement of a pair, of each edge by its (velocity, spin about itself)."""
    (v0, w0), (v1, w1) = first, second
    nodes = np.array([np.broadcast_to(v, 3) for v in (v0, v0, v1, v1)])
    return np.concatenate([nodes.ravel(), [w0, w1]])


def test_rods_that_move_as_one_body_do_not_slip(rng):
    """Turning together about any axis, each edge spins by its share of it."""
    pairs = skew_pairs(rng)
    shift, omega = rng.standard_normal((2, len(pairs), 1, 3))
    nodes = shift + np.cross(omega, pairs)
    edges = pairs[:, [1, 3]] - pairs[:, [0, 2]]
    spin = np.sum(omega * edges, axis=2) / np.linalg.norm(edges, axis=2)
    motion = np.concatenate([nodes.reshape(-1, 12), spin], axis=1)
    found = np.einsum("nij,nj->ni", slip_of(pairs), motion)
    assert np.abs(found).max() < 1e-11
    motion[:, 12] += 1.0  # one that spins on its own does
    turned = np.einsum("nij,nj->ni", slip_of(pairs), motion)
    assert np.linalg.norm(turned, axis=1).max() > 0.4 * DIAMETER


STILL = (np.zeros(3), 0.0)


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        (([1.0, 0, 0], 0.0), STILL, [1.0, 0, 0]),  # along its axis
        (([0, 1.0, 0], 0.0), STILL, [0, 1.0, 0]),  # across it
        (([0, 0, 1.0], 0.0), STILL, [0, 0, 0]),  # away from the other
        (STILL, ([1.0, 2.0, 3.0], 0.0), [-1.0, -2.0, 0]),
        ((np.zeros(3), 1.0), STILL, [0, GAP / 2, 0]),  # spinning: its lower side moves along y
        (STILL, (np.zeros(3), 1.0), [-GAP / 2, 0, 0]),  # likewise: its upper side moves along x
        (([0, -GAP / 2, 0], 1.0), STILL, [0, 0, 0]),  # rolling
    ],
)
def test_slip_is_the_velocity_of_one_surface_over_the_other(first, second, expected):
    found = slip_of(CROSS[None])[0] @ moved(CROSS, first, second)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_slip_of_a_rod_that_tilts():
    """About y through its middle: the surface below swings along x, the other way."""
    tilt = np.zeros((4, 3))
    tilt[0, 2], tilt[1, 2] = 1.0, -1.0
    motion = np.concatenate([tilt.ravel(), [0, 0]])
    np.testing.assert_allclose(slip_of(CROSS[None])[0] @ motion, [-GAP / 2, 0, 0], atol=1e-9)


@jax.jit
@jax.vmap
def rubbing(x, data):
    """Dissipation, and its derivatives by formula and by automatic differentiation."""
    law = FrictionDissipation()
    formula = law.gradient(x, data), law.hessian(x, data)
    return law(x, data), *formula, jax.grad(law)(x, data), jax.hessian(law)(x, data)


@pytest.fixture(scope="module")
def rubbed() -> tuple[np.ndarray, ...]:
    """For slip far below, about and far above the smallest: its size, the motion, the slip.

    Then what `rubbing` finds.
    """
    rng = np.random.default_rng(4)
    matrix = slip_of(skew_pairs(rng))
    n = len(matrix)
    smallest = 1e-3
    size = smallest * 10.0 ** rng.uniform(-3, 3, n)
    size[:10] = 0.0
    old, move = rng.standard_normal((2, n, 14))
    data = SlipData(matrix, jnp.asarray(old), jnp.full(n, 2.5), jnp.full(n, smallest))
    slipped = size[:, None] * np.einsum("nij,nj->ni", matrix, move)
    found = rubbing(old + size[:, None] * move, data)
    return size, move, slipped, *(np.asarray(v) for v in found)


def test_friction_force_is_the_slope_of_the_dissipation(rubbed):
    *_, gradient, hessian, by_jax, bend_by_jax = rubbed
    np.testing.assert_allclose(gradient, by_jax, atol=1e-13 * np.abs(by_jax).max())
    np.testing.assert_allclose(hessian, bend_by_jax, atol=1e-12 * np.abs(bend_by_jax).max())
    assert np.linalg.eigvalsh(hessian).min() > -1e-10 * np.abs(hessian).max()  # convex


def test_friction_only_dissipates_and_tends_to_coulombs_law(rubbed):
    size, move, slipped, value, gradient, *_ = rubbed
    assert value.min() >= 0
    assert np.all(value[size == 0] == 0)
    assert np.sum(gradient * move, axis=1).min() >= 0
    push = -(gradient[:, :3] + gradient[:, 3:6])  # on the first edge
    force, slip_size = np.linalg.norm(push, axis=1), np.linalg.norm(slipped, axis=1)
    opposite = np.sum(push * slipped, axis=1)
    np.testing.assert_allclose(opposite, -force * slip_size, rtol=1e-9)
    assert force.max() <= 2.5 * (1 + 1e-12)
    fast = size > 0.1
    assert np.sum(fast) > 20
    assert force[fast].min() > 0.99 * 2.5


# A block on a slope ---------------------------------------------------------------------------

RAILS = Topology(6, ((0, 1), (2, 3), (4, 5)), (), fixed_dofs=(*range(12), 18, 19))
"""Two fixed rods along y, at x = -0.5 and 0.5, and across them one of length 2 along x."""

BLOCK = np.array([0.0, 0, 0, 0, 0.5, 0.5])
"""Mass of the nodes, kg; gravity is 1 m/s^2."""

STIFFNESS, SLIP_SPEED, STEP, STEPS = 5e3, 1e-5, 0.01, 100
MU = 0.5


def resting_gap(push: float) -> float:
    """Of two edges that press each other by this force (N), half an edge from an end of one."""
    overlap = np.sqrt(2 * RAMP * DIAMETER * push / STIFFNESS)
    assert overlap < RAMP * DIAMETER
    barrier = 1 - 2 * np.sqrt(0.25 * 0.75)
    return np.sqrt((DIAMETER - overlap) ** 2 - (SOFTNESS * DIAMETER) ** 2 * barrier)


def on_a_slope(tangent: float, above: float = 0.0) -> tuple[Scene, State]:
    """The block at rest on rails whose x axis points down a slope; or that far `above` (m)."""
    angle = np.arctan(tangent)
    z = resting_gap(0.5 * np.cos(angle)) + above
    nodes = np.array(
        [[-0.5, -1, 0], [-0.5, 1, 0], [0.5, -1, 0], [0.5, 1, 0], [-1, 0, z], [1, 0, z]]
    )
    rod, state = rest(RAILS, nodes)
    polar = jnp.full(3, 0.5 * (DIAMETER / 2) ** 2)
    pairs = Indices(np.array([[0, 2], [1, 2]]))
    contact = Contact(jnp.asarray(STIFFNESS), jnp.asarray(DIAMETER / 2), pairs, 2)
    terms = (
        Stretch(jnp.full(3, 1e4)),
        Inertia(jnp.concatenate([jnp.repeat(jnp.asarray(BLOCK), 3), polar])),
        Gravity(jnp.asarray(BLOCK), jnp.array([np.sin(angle), 0.0, -np.cos(angle)])),
        contact,
        Friction(jnp.asarray(MU), jnp.asarray(SLIP_SPEED)),
    )
    settings = NewtonSettings(jnp.asarray(1e-8), jnp.ones(RAILS.n_dofs))
    return Scene(rod, terms, None, settings, jnp.asarray(STEP), euler), state


def with_friction(scene: Scene, coefficient: Any) -> Scene:
    """The scene with another coefficient of friction."""
    *others, friction = scene.terms
    assert isinstance(friction, Friction)
    return replace(scene, terms=(*others, replace(friction, coefficient=coefficient)))


@jax.jit
def slide(scene: Scene, state: State, mu: Any) -> tuple[jax.Array, jax.Array, jax.Array, Any]:
    """How far the block slid (m), how fast, and what pressed it (N), after a second."""
    scene = with_friction(scene, mu)
    states, report = roll_frames(scene, state, 1, STEPS)
    last = jax.tree.map(lambda x: x[-1], states)
    pairs = share(scene.terms[3], scene.rod, last, scene.step_length)
    push = -positions(RAILS, pairs.gradient(last.q))[4:, 2].sum()
    x, v = positions(RAILS, last.q), positions(RAILS, last.velocity)
    return 0.5 * (x[4, 0] + x[5, 0]), 0.5 * (v[4, 0] + v[5, 0]), push, report


def test_block_presses_by_its_weight():
    for tangent in (0.0, 0.3):
        _, _, push, report = slide(*on_a_slope(tangent), MU)
        assert report.ok
        assert float(push) == pytest.approx(np.cos(np.arctan(tangent)), rel=1e-3)


def test_block_stays_on_a_slope_below_the_angle_of_friction():
    """But for creep at about the speed below which friction is regularised."""
    for part in (0.2, 0.9, 0.98):
        distance, speed, _, report = slide(*on_a_slope(part * MU), MU)
        assert report.ok
        creep = SLIP_SPEED * part / np.sqrt(1 - part**2)
        assert 0 < float(distance) < 1.5 * creep
        assert float(speed) == pytest.approx(creep, rel=0.05)


@pytest.mark.parametrize(("tangent", "mu"), [(1.02 * MU, MU), (0.8, MU), (0.8, 0.2), (0.3, 0.0)])
def test_block_slides_down_a_steeper_slope_as_coulomb_says(tangent, mu):
    """With acceleration g (sin a - mu cos a)."""
    _, speed, _, report = slide(*on_a_slope(tangent), mu)
    assert report.ok
    angle = np.arctan(tangent)
    expected = np.sin(angle) - mu * np.cos(angle)
    assert float(speed) == pytest.approx(expected, abs=2e-3 * np.sin(angle))


def test_threshold_of_sliding_is_the_coefficient_of_friction():
    low, high = 0.9, 1.1
    while high - low > 2e-3:
        middle = 0.5 * (low + high)
        distance, _, _, report = slide(*on_a_slope(middle * MU), MU)
        assert report.ok
        slides = float(distance) > 100 * SLIP_SPEED
        low, high = (low, middle) if slides else (middle, high)
    assert low == pytest.approx(1, abs=0.02)


run = jax.jit(roll_frames, static_argnums=(2, 3))


@pytest.mark.slow
@pytest.mark.parametrize("spin", [60.0, -60.0, 20.0])
def test_spinning_rod_drives_itself_sideways_until_it_rolls(spin):
    """With mu g, while mu N r slows its spin; then as a cylinder rolls, at a third of its spin."""
    scene, state = on_a_slope(0.0)
    around_itself = RAILS.edge_dofs((2,))
    state = replace(state, velocity=state.velocity.at[around_itself].set(spin))
    states, report = run(scene, state, 1, STEPS)
    assert report.ok
    velocity = np.asarray(states.velocity)[-1]
    radius, mass = DIAMETER / 2, BLOCK.sum()
    speed = min(MU * STEP * STEPS, abs(spin) * radius / 3)
    slowed = mass * speed * radius / (0.5 * mass * radius**2)
    ends = positions(RAILS, velocity)[4:]
    np.testing.assert_allclose(ends[:, 1], -np.sign(spin) * speed, rtol=0.01)
    assert float(velocity[around_itself][0]) == pytest.approx(
        np.sign(spin) * (abs(spin) - slowed), rel=0.01
    )


@pytest.mark.slow
def test_distance_of_sliding_by_the_coefficient_of_friction():
    """Its derivative, central differences, and -g cos(a) t^2 / 2."""
    scene, state = on_a_slope(0.8)
    slope = float(jax.jit(jax.jacfwd(lambda mu: slide(scene, state, mu)[0]))(MU))
    ends = [float(slide(scene, state, MU + s * 1e-4)[0]) for s in (-1, 1)]
    assert slope == pytest.approx((ends[1] - ends[0]) / 2e-4, rel=1e-5)
    assert slope == pytest.approx(-0.5 * np.cos(np.arctan(0.8)), rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tangent", "above"), [(0.0, 0.0), (0.2, 0.0), (0.8, 0.0), (0.2, 0.05), (0.2, 10.0)]
)
def test_derivatives_are_finite_and_the_same_in_both_modes(tangent, above):
    """At rest, sliding, while falling on the rails, and far from them; by all numbers."""
    scene, state = on_a_slope(tangent, above)
    gradient = gradient_of_slide(scene, state)
    for leaf in jax.tree.leaves(gradient):
        assert np.isfinite(leaf).all()
    friction = gradient.terms[-1].coefficient
    assert (abs(float(friction)) > 1e-8) == (tangent > 0 and above == 0)
    forward = float(slope_of_slide(scene, state, MU))
    assert forward == pytest.approx(float(friction), rel=1e-9, abs=1e-14)


def soon(scene: Scene, state: State) -> jax.Array:
    """Where the block is after a few steps, m."""
    states, _ = roll_frames(scene, state, 1, 5)
    return jnp.mean(positions(RAILS, states.q[-1])[4:, 0])


gradient_of_slide = jax.jit(jax.grad(soon, allow_int=True))


@pytest.mark.slow
def test_the_stiffness_of_contact_is_one_number():
    """Its derivative is all of it: friction asks the contact, and keeps no copy."""
    scene, state = on_a_slope(0.8)
    *before, contact, friction = scene.terms
    assert isinstance(contact, Contact)
    gradient = gradient_of_slide(scene, state).terms[-2].stiffness
    ends = []
    for factor in (0.999, 1.001):
        other = replace(contact, stiffness=factor * contact.stiffness)
        ends.append(float(soon_jitted(replace(scene, terms=(*before, other, friction)), state)))
    assert float(contact.stiffness * gradient) == pytest.approx(
        (ends[1] - ends[0]) / 2e-3, rel=1e-4
    )


soon_jitted = jax.jit(soon)


@jax.jit
def slope_of_slide(scene: Scene, state: State, mu: Any) -> jax.Array:
    """By the coefficient of friction, in forward mode."""
    return jax.jacfwd(lambda mu: soon(with_friction(scene, mu), state))(mu)


# Pulled around --------------------------------------------------------------------------------

BARS, SOFT = 25, 40
N_NODES = 2 * BARS + SOFT + 1
FIRST = 2 * BARS
"""Of the nodes of the soft rod."""


def bars_and_rod() -> Topology:
    """Fixed rods of one edge, and a soft one whose last end is led."""
    bars = [(2 * i, 2 * i + 1) for i in range(BARS)]
    soft = [(FIRST + i, FIRST + i + 1) for i in range(SOFT)]
    hinges = [(BARS + i, BARS + i + 1) for i in range(SOFT - 1)]
    free = Topology(N_NODES, tuple(bars + soft), tuple(hinges))
    held = held_dofs(free, [*range(2 * BARS), N_NODES - 1], [*range(BARS), BARS + SOFT - 1])
    return Topology(N_NODES, free.edges, free.hinges, fixed_dofs=held)


CAPSTAN = bars_and_rod()
ROD_AND_BARS = Indices(np.array([[b, BARS + e] for b in range(BARS) for e in range(SOFT)]))
THICK, EA, LOAD = 0.02, 1e4, 1.0

step = jax.jit(advance)


def rotated_about_x(n_bars: int, radius: float, sides: int, corner: float) -> np.ndarray:
    """Nodes of bars on a circle, and of a rod that runs round them in a polygon.

    Args:
        n_bars: along y; those that are left over are far away. One bar is at the centre.
        radius: of the circle, m.
        sides: of the polygon that the rod runs around, touching the bars in their middles.
        corner: between the sides, rad.
    """
    angle = corner * np.arange(n_bars)
    centres = np.full((BARS, 3), 100.0) * np.arange(1, BARS + 1)[:, None]
    centres[:n_bars] = radius * np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    width = 2 * THICK
    half = np.array([0, width, 0])
    bars = np.stack([centres - half, centres + half], axis=1).reshape(-1, 3)
    inner = THICK if n_bars == 1 else radius + THICK
    edge = 2 * (inner - 1e-4 * THICK) * np.tan(corner / 2)
    legs = (SOFT - sides) // 2
    turn = corner * np.clip(np.arange(SOFT) - legs, 0, sides - 1)
    along = edge * np.stack([np.cos(turn), 0 * turn, -np.sin(turn)], axis=1)
    path = np.concatenate([np.zeros((1, 3)), np.cumsum(along, axis=0)])
    first_touch = path[legs] + 0.5 * along[legs]
    path += np.array([0, 0, inner - 1e-4 * THICK]) - first_touch
    return np.concatenate([bars, path])


def pulled(nodes: np.ndarray, mu: float, ei: float, strides: np.ndarray) -> dict[str, Any]:
    """The rod's last end led on by `strides` (m), against a load at its first end.

    Returns what the ends' torque about the y axis (N m) and the sum of normal forces (N) were
    after each of them; after the last, the tension of all edges and the angle wrapped.
    """
    rod, state = rest(CAPSTAN, nodes)
    rod = replace(rod, natural_curvature=0 * rod.natural_curvature)
    ahead, behind = (
        v / np.linalg.norm(v) for v in (nodes[-1] - nodes[-2], nodes[FIRST] - nodes[FIRST + 1])
    )
    contact = Contact(jnp.asarray(5e4), jnp.asarray(THICK / 2), ROD_AND_BARS, 60)
    slip_speed = 0.05 * np.abs(strides[0])
    terms = (
        *elasticity(rod, EA, ei, ei),
        Gravity(jnp.zeros(N_NODES).at[FIRST].set(LOAD), jnp.asarray(behind)),
        contact,
        Friction(jnp.asarray(mu), jnp.asarray(slip_speed)),
    )
    settings = NewtonSettings(jnp.asarray(1e-8), jnp.ones(CAPSTAN.n_dofs))
    scene = Scene(rod, terms, None, settings, jnp.ones(()), euler)
    torque, push = [], []
    x, tension = nodes[FIRST:], np.zeros(SOFT)
    for stride in strides:
        velocity = state.velocity.at[3 * N_NODES - 3 : 3 * N_NODES].set(stride * ahead)
        state, info = step(scene, at_speed(state, velocity))
        assert info.status == Status.OK, Status(int(info.status))
        x = np.asarray(positions(CAPSTAN, state.q))[FIRST:]
        length = np.linalg.norm(np.diff(x, axis=0), axis=1)
        tension = EA * (length / np.asarray(rod.rest_length)[BARS:] - 1)
        ends = np.cross(x[[0, -1]], [x[1] - x[0], x[-1] - x[-2]])[:, 1] / length[[0, -1]]
        torque.append(ends @ (tension[[0, -1]] * [-1, 1]))
        push.append(float(pressing(scene, state)))
    np.testing.assert_allclose(x[-1], nodes[-1] + np.sum(strides) * ahead, atol=1e-12)
    t = np.asarray(tangents(CAPSTAN, positions(CAPSTAN, state.q)))[BARS:]
    corner = np.arccos(np.clip(np.sum(t[1:] * t[:-1], axis=1), -1, 1))
    return {
        "torque": np.array(torque),
        "push": np.array(push),
        "tension": tension,
        "wrapped": corner.sum(),
    }


@jax.jit
def pressing(scene: Scene, state: State) -> jax.Array:
    """The sum of all normal forces, N."""
    contact = scene.terms[-2]
    assert isinstance(contact, Contact)
    pairs = share(contact, scene.rod, state, scene.step_length)
    local = jax.vmap(pairs.potential.gradient)(state.q[pairs.dofs], pairs.data)
    force = jnp.where(pairs.mask[:, None], local, 0.0)[:, :6].reshape(-1, 2, 3).sum(axis=1)
    return jnp.sum(jnp.sqrt(jnp.sum(force**2, axis=1)))


BACK_AND_FORTH = 1e-3 * np.repeat([-1.0, 1.0], 10)
"""Strides: in the end the bars are in the middles of edges, where a polygon pulls like a curve."""


@pytest.mark.parametrize("mu", [0.0, 0.2, 0.4])
@pytest.mark.parametrize("n_bars", [13, 25])
def test_capstan(mu, n_bars):
    """A thin rod around a drum of bars, through a quarter or half of a turn: exp(mu phi)."""
    phi = (n_bars - 1) * np.pi / 24
    found = pulled(rotated_about_x(n_bars, 1.0, n_bars, np.pi / 24), mu, 1e-4, BACK_AND_FORTH)
    tension = found["tension"]
    assert found["wrapped"] == pytest.approx(phi, rel=0.02)
    assert tension[0] == pytest.approx(LOAD, rel=1e-3)
    assert tension[-1] / tension[0] == pytest.approx(np.exp(mu * phi), rel=0.05)


def test_rod_around_a_rod():
    """Of equal radius: friction acts halfway between their centre lines.

    So its torque about the fixed rod is that of mu N at the radius of that rod.
    """
    mu = 0.4
    found = pulled(rotated_about_x(1, 0.0, 15, 0.2), mu, 1e-4, np.full(20, 2e-4))
    assert found["tension"][-1] > 1.5 * LOAD
    expected = mu * found["push"][8:] * THICK / 2
    assert np.all(np.abs(found["torque"][8:] / expected - 1) < 0.02)
