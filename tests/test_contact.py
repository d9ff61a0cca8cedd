"""Contact: its law, the search for pairs, and rods that press, collide and bounce.

Two rods of unit length, a tenth thick, with five edges each so that their middles are not at a
node. In steps of time without inertia or drag what is found is an equilibrium.
"""

from itertools import pairwise, product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import advance, elasticity, expand, held_dofs, order, potential, rest, rotation, share

from derjax import Scene, State, Topology, positions, roll_frames
from derjax.core.pytree import replace
from derjax.core.status import Status
from derjax.integrate.schemes.euler import euler
from derjax.solve.contributions import Contacts, Pairs
from derjax.solve.newton import NewtonSettings
from derjax.solve.potential import assemble
from derjax.terms import Gravity, Inertia, Term
from derjax.terms.contact.neighbours import Neighbours, pairs_apart, search
from derjax.terms.contact.repulsion import (
    RAMP,
    SOFTNESS,
    Contact,
    ContactEnergy,
    ContactLaw,
    energy,
    force,
    meeting,
)
from derjax.terms.contact.segments import distance

# Where centre lines cross, rounding shows a thousandfold, and more of it without optimisation.
pytestmark = pytest.mark.optimised

N = 5
DIAMETER = 0.1
WIDTH = RAMP * DIAMETER


# One pair -------------------------------------------------------------------------------------

TOUCH = ContactLaw(jnp.asarray(50.0), jnp.asarray(DIAMETER))


def pairs_at(gaps: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(n, 4, 3) edges about twice the diameter long, at these distances (m), of every kind."""
    pairs = []
    for k, gap in enumerate(gaps):
        angle = [0.0, np.pi, 1e-9, 1e-3, 0.1, 1.3, rng.uniform(0, np.pi)][k % 7]
        shift = [0.0, 0.5, 1.0, 1.3, rng.uniform(-1.2, 1.2)][k % 5]
        u = np.array([1.0, 0, 0])
        v = np.array([np.cos(angle), np.sin(angle), 0])
        start = shift * u - (k % 3) / 2 * v if angle > 0.05 else shift * u
        x = np.array([0 * u, u, start, start + v]) * rng.uniform(0.1, 0.3)
        x[2:] += (gap if shift < 1.1 or angle < 0.05 else 0.5 * gap) * np.array([0, 0, 1.0])
        pairs.append(x @ np.asarray(rotation(rng.standard_normal(3), rng.uniform(0, 3))).T)
    return np.array(pairs)


RNG = np.random.default_rng(3)
GAPS = DIAMETER * np.concatenate(
    [
        RNG.uniform(1.0, 1.3, 100),  # no contact
        1.0 - RAMP * RNG.uniform(0, 1, 200),  # ramp
        RNG.uniform(0.5, 1 - RAMP, 200),  # beyond the ramp
        [0.0] * 35,  # centre lines that cross, or overlap
    ]
)
PAIRS = pairs_at(GAPS, RNG)


@jax.jit
@jax.vmap
def of_pair(pair):
    """Distance, energy, and its derivatives by formula and by automatic differentiation."""
    x, law = pair.ravel(), ContactEnergy()
    return {
        "distance": meeting(x, TOUCH.diameter)[1],
        "energy": law(x, TOUCH),
        "gradient": law.gradient(x, TOUCH),
        "hessian": law.hessian(x, TOUCH),
        "autodiff gradient": jax.grad(law)(x, TOUCH),
        "autodiff hessian": jax.jacfwd(jax.grad(law))(x, TOUCH),
    }


@pytest.fixture(scope="module")
def pair_values() -> dict[str, np.ndarray]:
    return {k: np.asarray(v) for k, v in of_pair(PAIRS).items()}


def test_pairs_are_in_all_regimes(pair_values):
    overlap = DIAMETER - pair_values["distance"]
    assert np.sum(overlap < 0) > 50
    assert np.sum((overlap > 0) & (overlap < WIDTH)) > 50
    assert np.sum(overlap > WIDTH) > 50


def test_force_of_a_pair_is_the_slope_of_its_energy(pair_values):
    gradient, expected = pair_values["gradient"], pair_values["autodiff gradient"]
    size = float(TOUCH.stiffness) * DIAMETER
    usual = GAPS > 0
    assert np.isfinite(expected).all()
    assert np.abs(expected).max() > 0.5 * size
    assert np.abs(gradient - expected)[usual].max() < 1e-12 * size
    # where centre lines cross the distance bends a millionth of a diameter away
    assert np.abs(gradient - expected)[~usual].max() < 1e-9 * size


def test_stiffness_of_a_pair_is_the_slope_of_its_force(pair_values):
    hessian, expected = pair_values["hessian"], pair_values["autodiff hessian"]
    usual = GAPS > 0
    scale = 1 + np.abs(expected).max(axis=(1, 2), keepdims=True)
    assert np.isfinite(expected).all()
    assert np.abs((hessian - expected) / scale)[usual].max() < 1e-11
    assert np.abs((hessian - expected) / scale)[~usual].max() < 1e-9
    np.testing.assert_allclose(hessian, hessian.transpose(0, 2, 1), atol=1e-12 * hessian.max())


def test_pairs_exert_no_net_force_or_torque(pair_values):
    push = pair_values["gradient"].reshape(-1, 4, 3)
    size = np.abs(push).max()
    assert np.abs(push.sum(axis=1)).max() < 1e-14 * size
    assert np.abs(np.cross(PAIRS, push).sum(axis=1)).max() < 1e-14 * size


def test_rods_repel_along_the_line_between_them(pair_values):
    """Parallel edges side by side: half of the force on either end, across both."""
    side_by_side = np.array([[0, 0, 0], [0.2, 0, 0], [0, 0, 0.098], [0.2, 0, 0.098]])
    push = -of_pair(np.resize(side_by_side, PAIRS.shape))["gradient"][0].reshape(4, 3)
    expected = 50.0 * (0.002 - WIDTH / 2)
    np.testing.assert_allclose(push[:, 2], np.array([-1, -1, 1, 1]) * expected / 2, rtol=1e-9)
    np.testing.assert_allclose(push[:, :2], 0.0, atol=1e-14)


@jax.jit
@jax.vmap
def law(d: jax.Array) -> jax.Array:
    """Force, then energy and its first three derivatives, at a distance (m)."""
    slope = jax.grad(energy)
    bend = jax.grad(slope)
    derivatives = [f(d, TOUCH) for f in (energy, slope, bend, jax.grad(bend))]
    return jnp.stack([force(d, TOUCH), *derivatives])


def test_law_of_the_force():
    """Zero, then quadratic, then linear in the overlap; the slope of its energy; C^2 throughout."""
    overlap = WIDTH * np.array([-10.0, 0.5, 3.0, -1e-9, 1e-9, 1 - 1e-9, 1 + 1e-9])
    found = np.asarray(law(DIAMETER - overlap))
    unit = 50.0 * WIDTH * np.array([1, WIDTH, 1, 1 / WIDTH, 1 / WIDTH**2])
    found = found / unit
    np.testing.assert_allclose(found[:3, 0], [0, 0.125, 2.5], atol=1e-13)
    np.testing.assert_allclose(found[:, 2], -found[:, 0], atol=1e-13)
    for below, above in ((3, 4), (5, 6)):
        np.testing.assert_allclose(found[below, :4], found[above, :4], atol=1e-8)
        assert abs(found[below, 4] - found[above, 4]) == pytest.approx(1, abs=1e-6)


# Two rods -------------------------------------------------------------------------------------


def two_rods(**fields: Any) -> Topology:
    """Two rods that have nothing in common."""
    edges = tuple((k + i, k + i + 1) for k in (0, N + 1) for i in range(N))
    hinges = tuple((k + i, k + i + 1) for k in (0, N) for i in range(N - 1))
    return Topology(2 * N + 2, edges, hinges, **fields)


FREE = two_rods()
ENDS = (0, 1, N - 1, N)
CLAMPED = two_rods(
    fixed_dofs=held_dofs(FREE, [*ENDS, *(N + 1 + i for i in ENDS)], [0, N - 1, N, 2 * N - 1])
)
APART = pairs_apart(FREE, np.full(2 * N, 1 / N), 10.0)
"""Any edge of the one rod with any of the other."""

FIRST, SECOND = np.arange(N + 1), np.arange(N + 1, 2 * N + 2)


def placed(gap: float, angle: float = np.pi / 2, slide: float = 0.0) -> np.ndarray:
    """Nodes of two straight rods, `gap` apart in their middles, at an angle (rad)."""
    x = np.linspace(-0.5, 0.5, N + 1)
    first = np.stack([x, 0 * x, 0 * x], axis=1)
    second = np.stack([x * np.cos(angle) + slide, x * np.sin(angle), 0 * x + gap], axis=1)
    return np.concatenate([first, second])


MASS = np.tile([0.5, *[1.0] * (N - 1), 0.5], 2) / N
"""Of the nodes: that of a rod is 1."""

WEIGHTS = jnp.concatenate(
    [jnp.repeat(jnp.asarray(MASS), 3), jnp.full(2 * N, 0.5 * (DIAMETER / 2) ** 2 / N)]
)


def scene_of(
    topology: Topology,
    nodes: np.ndarray,
    *more: Term,
    stiffness: float = 1e3,
    ei: float = 100.0,
    ea: float = 1e5,
    step: float = 1.0,
    capacity: int = len(APART.array),
) -> tuple[Scene, State]:
    """Two elastic rods that do not pass through each other."""
    rod, state = rest(topology, nodes)
    contact = Contact(jnp.asarray(stiffness), jnp.asarray(DIAMETER / 2), APART, capacity)
    terms = (*elasticity(rod, ea, ei, ei), *more, contact)
    settings = NewtonSettings(jnp.asarray(1e-9), jnp.ones(topology.n_dofs))
    return Scene(rod, terms, None, settings, jnp.asarray(step), euler), state


def free_rods(nodes: np.ndarray, load: float = 0.0, **numbers: Any) -> tuple[Scene, State]:
    """Two rods in vacuum, and a force (N) that presses them together along z."""
    press = jnp.asarray(MASS).at[SECOND].mul(-1.0)
    dead = Gravity(press, jnp.array([0.0, 0.0, load]))
    return scene_of(FREE, nodes, Inertia(WEIGHTS), dead, **numbers)


def approaching(state: State, speed: float) -> State:
    """Both rods with this speed along z, towards each other."""
    velocity = np.zeros((2 * N + 2, 3))
    velocity[FIRST, 2], velocity[SECOND, 2] = speed, -speed
    return replace(state, velocity=state.velocity.at[: velocity.size].set(velocity.ravel()))


step = jax.jit(advance)


def contact_of(scene: Scene) -> Contact:
    (contact,) = (t for t in scene.terms if isinstance(t, Contact))
    return contact


@jax.jit
def contact_forces(scene: Scene, state: State) -> tuple[jax.Array, jax.Array]:
    """(n, 3) force on each node, N, and the energy of all contacts, J."""
    pairs = share(contact_of(scene), scene.rod, state, scene.step_length)
    return -positions(scene.rod.topology, pairs.gradient(state.q)), pairs.value(state.q)


def height(state: State) -> float:
    """Of the second rod's middle above that of the first."""
    z = np.asarray(positions(FREE, state.q))[:, 2]
    return float(MASS[SECOND] @ z[SECOND] - MASS[FIRST] @ z[FIRST])


# The list of pairs ----------------------------------------------------------------------------


FEW = 2
"""Places of a list that is too short."""


@jax.jit
def look(q: jax.Array, move: jax.Array) -> Neighbours:
    return found_with(q, move, len(APART.array))


@jax.jit
def look_short(q: jax.Array, move: jax.Array) -> Neighbours:
    return found_with(q, move, FEW)


def found_with(q: jax.Array, move: jax.Array, capacity: int) -> Neighbours:
    rod, state = rest(FREE, placed(1.0))
    return search(rod, replace(state, q=q), move, APART, jnp.asarray(DIAMETER), capacity)


def as_dofs(nodes: np.ndarray) -> jax.Array:
    return jnp.asarray(np.concatenate([np.ravel(nodes), np.zeros(2 * N)]))


def tangled(rng: np.random.Generator) -> np.ndarray:
    """Two rods of random shape that pass each other closely."""
    nodes = placed(rng.uniform(1, 3) * DIAMETER, rng.uniform(0, np.pi), rng.uniform(-0.5, 0.5))
    return nodes + 0.2 * DIAMETER * rng.standard_normal(nodes.shape)


all_distances = jax.jit(distance)


def every_distance(nodes: np.ndarray) -> np.ndarray:
    return np.asarray(all_distances(nodes[FREE.edge_nodes[APART.array].reshape(-1, 4)]))


def test_pairs_that_could_ever_touch():
    """Those with more than the gap of rod between them, along any way; here a Y with a ring."""
    edges = ((0, 1), (1, 2), (2, 3), (1, 4), (4, 5), (6, 7), (7, 8), (8, 6))
    lengths = np.array([1.0, 2.0, 1.0, 0.5, 1.0, 1.0, 1.0, 5.0])
    pairs = {tuple(p) for p in pairs_apart(Topology(9, edges, ()), lengths, 1.9).array.tolist()}
    # on the Y: 0-2 have edge 1 (2.0) between them, 2-3 too, 2-4 edges 1 and 3, 0-4 edge 3 (0.5),
    # 1-4 edge 3 (0.5); everything else touches
    same = {(0, 2), (2, 3), (2, 4)}
    other = set(product(range(5), range(5, 8)))
    assert pairs == same | other
    assert (0, 4) in {
        tuple(p) for p in pairs_apart(Topology(9, edges, ()), lengths, 0.4).array.tolist()
    }


@pytest.mark.parametrize("speed", [0.0, 0.3, 2.0])
def test_list_holds_all_pairs_that_come_near(rng, speed):
    """Those that touch anywhere on the way, if no node goes astray by more than half the margin."""
    listed_at_all, near_at_all = 0, 0
    for _ in range(50):
        nodes = tangled(rng)
        move = speed * DIAMETER * rng.standard_normal(nodes.shape)
        found = look(as_dofs(nodes), as_dofs(move))
        edges = np.asarray(found.edges)[np.asarray(found.mask)]
        assert int(found.found) == len(edges)
        np.testing.assert_array_equal(
            np.asarray(found.nodes)[np.asarray(found.mask)], FREE.edge_nodes[edges].reshape(-1, 4)
        )
        listed = {tuple(e) for e in edges.tolist()}
        astray = rng.standard_normal(nodes.shape)
        astray *= 0.499 * float(found.margin) / np.linalg.norm(astray, axis=1, keepdims=True)
        for part in np.linspace(0.0, 1.0, 9):
            close = every_distance(nodes + part * (move + astray)) < DIAMETER
            assert {tuple(e) for e in APART.array[close].tolist()} <= listed
        listed_at_all += len(edges)
        reached = 2.0 * np.linalg.norm(move, axis=1).max() + float(found.margin)
        near_at_all += int((every_distance(nodes) < DIAMETER + reached).sum())
    assert 50 < listed_at_all <= near_at_all
    if speed == 0.0:  # nothing moves: these and no others
        assert listed == {
            tuple(e)
            for e in APART.array[every_distance(nodes) < DIAMETER + float(found.margin)].tolist()
        }


reach = jax.jit(lambda found, q, move: found.max_step(q, move))


def test_what_turns_as_a_whole_does_not_come_closer_to_itself(rng):
    """However far it turns, all of the way may be gone, and the list is that of a rod at rest."""
    nodes, c, s = tangled(rng), np.cos(0.5), np.sin(0.5)
    move = nodes @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T - nodes
    found = look(as_dofs(nodes), as_dofs(move))
    listed = np.asarray(found.edges)[np.asarray(found.mask)]
    near = every_distance(nodes) < DIAMETER + float(found.margin)
    np.testing.assert_array_equal(listed, APART.array[near])
    assert float(reach(found, as_dofs(nodes), as_dofs(move))) == 1.0


def test_pairs_that_go_by_their_law_and_the_others_are_all_that_touch():
    """Second derivatives: a list with room for some of the pairs, and what is left beside it."""
    nodes = placed(0.9 * DIAMETER, angle=0.25)
    scene, state = free_rods(nodes)
    pairs = share(contact_of(scene), scene.rod, state, scene.step_length)
    assert isinstance(pairs, Contacts)
    touching = int(np.sum(every_distance(nodes) < DIAMETER))
    assert touching > FEW
    near, rest = pairs.split(state.q, FEW)
    assert int(near.mask.sum()) == FEW
    assert 0 < int(rest.mask.sum()) <= touching - FEW < int(pairs.mask.sum()) - FEW
    nothing = jnp.zeros((state.q.size,) * 2)
    whole = pairs.add_hessian(nothing, state.q)
    parts = rest.add_hessian(near.add_hessian(nothing, state.q), state.q)
    np.testing.assert_allclose(parts, whole, rtol=1e-12, atol=1e-12 * float(jnp.abs(whole).max()))


def test_rods_may_slide_along_each_other_but_not_approach_by_more_than_half():
    nodes = placed(1.5 * DIAMETER, 0.0)
    slide, approach = np.zeros_like(nodes), np.zeros_like(nodes)
    slide[N + 1 :, 0] = DIAMETER
    approach[N + 1 :, 2] = -3.0 * DIAMETER
    found = look(as_dofs(nodes), as_dofs(approach))
    assert float(reach(found, as_dofs(nodes), as_dofs(slide))) == 1.0
    part = float(reach(found, as_dofs(nodes), as_dofs(approach)))
    assert part == pytest.approx(0.25, rel=1e-9)  # 0.75 of 3 diameters


fault = jax.jit(lambda found, q: found.status(q))


def test_list_that_is_too_short_is_a_fault(rng):
    overflows = 0
    for _ in range(50):
        q = as_dofs(tangled(rng))
        full, short = look(q, 0 * q), look_short(q, 0 * q)
        assert int(full.found) == int(short.found)
        if int(short.found) > FEW:
            overflows += 1
            assert fault(short, q) == Status.CAPACITY
        else:
            listed = np.asarray(short.edges)[np.asarray(short.mask)]
            assert len(listed) == int(full.found)
            assert fault(short, q) == fault(full, q)
    assert 5 < overflows < 45


@pytest.mark.parametrize(
    ("start", "end", "expected"),
    [
        (1.02, 1.02, Status.OK),
        (1.02, 0.991, Status.OK),
        (1.02, 0.989, Status.PENETRATION),
        (2.2, 1.0, Status.OK),  # a pair that was not listed
        (3.0, 0.5, Status.TOO_FAST),
        (2.2, 0.98, Status.PENETRATION),  # the same
        (1.02, -1.02, Status.TOO_FAST),  # through each other
    ],
)
def test_faults_of_a_step(start, end, expected):
    """Of rods that are so many diameters apart at its start and its end, both having moved."""
    found = look(as_dofs(placed(start * DIAMETER)), as_dofs(np.zeros((2 * N + 2, 3))))
    nodes = placed(start * DIAMETER)
    nodes[FIRST, 2] += (start - end) / 2 * DIAMETER
    nodes[SECOND, 2] -= (start - end) / 2 * DIAMETER
    assert fault(found, as_dofs(nodes)) == expected


def test_search_allows_for_the_speed():
    """What moves as expected, or a quarter faster, stays among the pairs that were listed."""
    nodes, move = placed(10 * DIAMETER), np.zeros((2 * N + 2, 3))
    move[FIRST, 2], move[SECOND, 2] = 2 * DIAMETER, -2 * DIAMETER
    found = look(as_dofs(nodes), as_dofs(move))
    for factor in (1.0, 1.25):
        after = nodes + factor * move
        assert fault(found, as_dofs(after)) == Status.OK
        unlisted = ~np.asarray(found.mask).any() * every_distance(after)
        assert np.all(unlisted > DIAMETER)


reach = jax.jit(lambda found, q, direction: found.max_step(q, direction))


def test_no_pair_can_get_through_within_reach(rng):
    """Everywhere on the way at least half of the least distance is left, however fast."""
    paths, limited, bounds = [], 0, []
    for k in range(100):
        nodes = tangled(rng)
        if k % 4 == 0:  # deep in each other, as iterates of Newton's method may be
            nodes = placed(0.2 * DIAMETER, rng.uniform(0.1, 3), rng.uniform(-0.3, 0.3))
        fast = 10.0 ** rng.uniform(-1, 3) * DIAMETER * rng.standard_normal(nodes.shape)
        found = look(as_dofs(nodes), as_dofs(fast))
        part = float(reach(found, as_dofs(nodes), as_dofs(fast)))
        assert 0 < part <= 1
        limited += part < 1
        way = np.linspace(0, 1, 50)[:, None, None]
        paths.append(nodes + way * part * fast)
        bounds.append(0.5 * every_distance(nodes))
    assert 20 < limited < 100
    moved = np.array(paths)[:, :, FREE.edge_nodes[APART.array].reshape(-1, 4)]
    apart = np.asarray(all_distances(moved))
    listed = np.array(bounds) < 0.5 * (1.5 * DIAMETER)
    closest = apart.min(axis=1)
    assert np.all((closest >= np.array(bounds) - 1e-12)[listed])


def test_reach_is_all_the_way_if_nothing_is_near():
    q = as_dofs(placed(5 * DIAMETER))
    assert reach(look(q, 0 * q), q, q) == 1.0


# Equilibria -----------------------------------------------------------------------------------


def softened(gap: float, *places: float) -> float:
    """Distance with which two rods that cross `gap` apart, at these places of edges, repel."""
    barrier = sum(1 - 2 * np.sqrt(a * (1 - a)) for a in places)
    return np.sqrt(gap**2 + (SOFTNESS * DIAMETER) ** 2 * barrier)


def inverse(push: float, stiffness: float) -> float:
    """The overlap at which two edges repel each other by this force."""
    if push < 0.5 * stiffness * WIDTH:
        return float(np.sqrt(2 * WIDTH * push / stiffness))
    return push / stiffness + 0.5 * WIDTH


@pytest.mark.slow
@pytest.mark.parametrize("load", [0.02, 0.1, 0.35])
def test_pressed_rods_overlap_as_the_law_says(load):
    """Two crossed rods, pressed against each other by dead loads, after they came to rest."""
    scene, state = free_rods(placed(DIAMETER), load, step=0.05, stiffness=1e3)
    for _ in range(60):
        state, info = step(scene, state)
        assert info.status == Status.OK
    assert np.abs(state.velocity).max() < 1e-6 * load
    push, _ = contact_forces(scene, state)
    assert float(push[SECOND, 2].sum()) == pytest.approx(load, rel=1e-6)
    assert float(push[FIRST, 2].sum()) == pytest.approx(-load, rel=1e-6)
    x = np.asarray(positions(FREE, state.q))
    middle = (x[[N // 2, N // 2 + 1]].mean(axis=0), x[SECOND][[N // 2, N // 2 + 1]].mean(axis=0))
    gap = middle[1][2] - middle[0][2]
    assert DIAMETER - gap == pytest.approx(inverse(load, 1e3), rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("approach", [0.006, 0.03, 0.06])
def test_crossed_beams_pressed_by_an_approach(approach):
    """Clamped at both ends: two beams that give way, in series with the contact."""
    stiffness, start = 5e3, approach * DIAMETER
    scene, state = scene_of(
        CLAMPED, placed(DIAMETER - start), stiffness=stiffness, ei=1.0, ea=100.0
    )
    bent, info = step(scene, state)
    assert info.status == Status.OK
    push = float(contact_forces(scene, bent)[0][SECOND, 2].sum())
    # the beam of five edges itself, by its own stiffness matrix
    free = np.setdiff1d(np.arange(FREE.n_dofs), CLAMPED.fixed_dofs)
    matrix = np.asarray(expand(scene.rod, state, scene.terms[:3], state.q)[2])[free][:, free]
    unit = np.zeros(FREE.n_dofs)
    unit[3 * FIRST[[N // 2, N // 2 + 1]] + 2] = 0.5
    yielding = unit[free] @ np.linalg.solve(matrix, unit[free])
    length = (N - 2) / N  # between the clamped edges
    # moments of 1/9 L at the walls and 1/18 L at the loads, in hinges of L/6 and L/3
    assert yielding == pytest.approx(length**3 / 162, rel=1e-3)
    assert 2 * yielding * push + inverse(push, stiffness) == pytest.approx(start, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("slide", [0.0, 0.03])
@pytest.mark.parametrize("tilt", [0.0, 1e-9, 1e-4, 3e-3])
def test_parallel_rods_pressed_along_their_whole_length(tilt, slide):
    """Newton's method converges, and the load is carried; however nearly parallel."""
    load = 0.5
    scene, state = free_rods(placed(DIAMETER, tilt, slide), load, step=0.02, stiffness=1e3)
    iterations = []
    for _ in range(15):
        state, info = step(scene, state)
        assert info.status == Status.OK
        iterations.append(int(info.iterations))
    assert max(iterations) <= 12
    push, _ = contact_forces(scene, state)
    if slide == 0.0:  # or else the loads turn the two
        assert float(push[SECOND, 2].sum()) == pytest.approx(load, rel=0.02)
        assert np.all(np.asarray(push[SECOND, 2]) > 0)  # all along
        assert 0.99 < height(state) / DIAMETER < 1.003


@jax.jit
def sliding_energy(shifts: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Energy of two parallel rods that touch, its slope and curvature as one slides."""
    scene, state = free_rods(placed(0.993 * DIAMETER, 0.0))
    pairs: Pairs = share(contact_of(scene), scene.rod, state, scene.step_length)
    along = jnp.zeros_like(state.q).at[3 * SECOND].set(1.0)

    def at(shift):
        q = state.q + shift * along
        return (
            pairs.value(q),
            pairs.gradient(q) @ along,
            along @ assemble([pairs]).hessian(q) @ along,
        )

    return jax.vmap(at)(shifts)


def test_parallel_rods_slide_over_each_others_nodes_smoothly():
    """Energy and force have no jump: each is the integral of the next."""
    shifts = np.linspace(-0.01, 0.01, 801)
    curve = [np.asarray(v) for v in sliding_energy(shifts)]
    h = shifts[1] - shifts[0]
    for value, slope in pairwise(curve):
        assert np.abs(slope).max() > 0
        error = np.diff(value) - h * 0.5 * (slope[1:] + slope[:-1])
        assert np.abs(error).max() < 0.02 * h * np.abs(slope).max()


# Collisions -----------------------------------------------------------------------------------

many_steps = jax.jit(roll_frames, static_argnums=(2, 3))
STEPS = 400


@jax.jit
@jax.vmap
def momentum_and_kinetic(velocity: jax.Array) -> tuple[jax.Array, jax.Array]:
    p = positions(FREE, WEIGHTS * velocity)
    return p.sum(axis=0), 0.5 * jnp.sum(WEIGHTS * velocity**2)


@jax.jit
def stored(scene: Scene, states: State) -> jax.Array:
    """Elastic energy and that of contacts in every one of the states, J."""

    def of(state):
        bodies = potential(scene.rod, state, scene.terms[:3]).value(state.q)
        return bodies + contact_forces(scene, state)[1]

    return jax.vmap(of)(states)


def collide(step_length: float, angle: float = 1.2, offset: float = 0.0) -> dict[str, Any]:
    """Two rods that meet at their middles, or `offset` beside, and part again."""
    speed = 0.008
    scene, state = free_rods(
        placed(1.002 * DIAMETER, angle, offset), step=step_length, stiffness=1e3
    )
    start = approaching(state, speed)
    states, report = many_steps(scene, start, STEPS, 1)
    assert report.ok, report.message()
    momentum, kinetic = momentum_and_kinetic(states.velocity)
    return {
        "states": states,
        "momentum": np.asarray(momentum),
        "energy": np.asarray(kinetic + stored(scene, states)),
        "initial": float(momentum_and_kinetic(start.velocity[None])[1][0]),
        "rebound": -float(np.asarray(states.velocity)[-1, 2 : 3 * N + 3 : 3] @ MASS[FIRST]) / speed,
    }


COLLISION_STEPS = (2e-3, 1e-3, 5e-4)


@pytest.fixture(scope="module")
def collisions() -> list[dict[str, Any]]:
    return [collide(h) for h in COLLISION_STEPS]


def test_collision_conserves_momentum(collisions):
    for run in (*collisions, collide(2e-3, 0.7, 0.13)):
        assert np.abs(run["momentum"]).max() < 1e-11


def test_collision_never_gains_energy(collisions):
    for run in (*collisions, collide(2e-3, 0.7, 0.13)):
        energy = np.concatenate([[run["initial"]], run["energy"]])
        assert np.diff(energy).max() < 1e-8 * run["initial"]


def test_rebound_becomes_elastic_with_smaller_steps(collisions):
    """Stiff rods that meet at their centres swap velocities; implicit Euler takes some."""
    rebound = [run["rebound"] for run in collisions]
    losses = 1 - np.array(rebound)
    assert np.all(losses > 0)
    assert order(list(COLLISION_STEPS), list(losses)) == pytest.approx(1, abs=0.2)
    assert 2 * rebound[-1] - rebound[-2] == pytest.approx(1, abs=0.01)


@pytest.mark.slow
def test_fast_rods_never_end_up_on_the_other_side():
    """Up to 30 diameters in a step, against contacts that are far too soft to stop them too."""
    rng = np.random.default_rng(0)
    ends = dict.fromkeys(Status, 0)
    for _ in range(150):
        gap, speed = rng.uniform(1, 3), 10.0 ** rng.uniform(-1, 1.5)
        scene, state = free_rods(
            placed(gap * DIAMETER, rng.uniform(0.3, 2.8)),
            stiffness=10.0 ** rng.uniform(0, 5),
            ei=10.0 ** rng.uniform(-3, 2),
        )
        state = approaching(state, speed * DIAMETER)
        status = Status.OK
        for _ in range(6):
            new, info = step(scene, state)
            status = Status(int(info.status))
            if status != Status.OK:
                break
            state = new
        assert height(state) > 0
        ends[status] += 1
    assert ends[Status.OK] > 30
    assert ends[Status.PENETRATION] > 10
