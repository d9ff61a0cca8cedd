"""What holds for every term: derivatives, symmetries of space, of labels, of drag matrices."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import carry, elasticity, perturbed, potential, rest, rotation, share

from derjax import State, Topology, angles, chain, positions
from derjax.core.pytree import replace
from derjax.rods.kinematics import tangents
from derjax.shapes import helix, helix_contour, single_flagellum
from derjax.solve.potential import assemble
from derjax.terms import (
    ExplicitDrag,
    Gravity,
    HeadDrag,
    Inertia,
    ResistiveDrag,
    SpinDrag,
    StokesletSegments,
)

N = 12
SEEDS = (0, 1, 2)
STEP = 0.1
HELIX = helix(0.1, 0.6, 1.0, N - 4, "left")
BODY = single_flagellum(HELIX, helix_contour(0.1, 0.6, 1.0) / (N - 4))
ROD, REST = rest(BODY.topology, BODY.nodes)
N_NODES = ROD.topology.n_nodes
FILAMENT = ROD.topology.filaments[0]
EVERY_NODE = tuple(range(N_NODES))


def stokeslets(solved=FILAMENT, **options) -> StokesletSegments:
    eps, viscosity = jnp.asarray(0.03), jnp.asarray(2.0)
    return StokesletSegments(viscosity, eps, (solved,), FILAMENT, **options)


ELASTIC = dict(zip(("stretch", "bend", "twist"), elasticity(ROD, ea=100.0), strict=True))
DRAG = {
    "head": HeadDrag(*(jnp.asarray(x) for x in (3.0, 0.5, 0.7, 0.1))),
    "RFT": ResistiveDrag(jnp.asarray(1.0), jnp.asarray(1.8)),
    "spin": SpinDrag(jnp.asarray(0.2)),
    "RSS": stokeslets(),
    "RSS, full weight": stokeslets(end_nodes="full"),
    "RSS, collocation": stokeslets(drag_matrix="collocation"),
    "RSS, lower triangle": stokeslets(drag_matrix="lower_triangle"),
    "RSS, head dropped": stokeslets(EVERY_NODE, drag_matrix="collocation"),
    "RSS, lagged": ExplicitDrag(stokeslets()),
}
MASS = jnp.concatenate([jnp.repeat(jnp.linspace(1, 2, N_NODES), 3), jnp.ones(N_NODES - 1)])
OTHERS = {
    "inertia": Inertia(MASS),
    "gravity": Gravity(MASS[: 3 * N_NODES : 3], jnp.array([1.0, 2.0, 3.0])),
}
TERMS = ELASTIC | DRAG | OTHERS


@jax.jit
def all_gradients(state, q, turn):
    """Gradient of every term at `q` in a step from `state`; gravity turned along."""
    found = {}
    for name, term in TERMS.items():
        if name == "gravity":
            term = replace(term, acceleration=turn @ term.acceleration)
        found[name] = potential(ROD, state, (term,), STEP).gradient(q)
    return found


def deformed(seed: int) -> tuple[State, jax.Array]:
    """A state that is bent and moving, and where it might be one step later."""
    rng = np.random.default_rng(seed)
    state = perturbed(ROD, REST, rng, 0.2)
    velocity = 0.1 * rng.standard_normal(ROD.topology.n_dofs)
    state = replace(state, velocity=jnp.asarray(velocity), motor_angle=jnp.array([0.4]))
    return state, perturbed(ROD, state, rng, 0.05).q


@jax.jit
def energies(state, q):
    """Of stretching, bending and twisting at `q`, as seen in a step from `state`."""
    return [potential(ROD, state, (term,), STEP).value(q) for term in ELASTIC.values()]


@jax.jit
def derivatives(state, q, along):
    """Of all that has a potential, by derjax's formulas and by automatic differentiation."""
    terms = (*ELASTIC.values(), DRAG["head"], DRAG["RFT"], DRAG["spin"], DRAG["RSS"])
    total = potential(ROD, state, terms, STEP)
    change = jax.jvp(total.gradient, (q,), (along,))[1]
    return total.gradient(q), jax.grad(total.value)(q), total.hessian(q), change


def act(q, turn, shift):
    """`q` turned and shifted; angles stay."""
    x = positions(ROD.topology, q) @ turn.T + shift
    return jnp.concatenate([x.ravel(), angles(ROD.topology, q)])


@pytest.mark.parametrize("seed", SEEDS)
def test_forces_and_stiffness_are_derivatives_of_the_potential(seed):
    """Away from the state at which the step began, where frames have been transported."""
    state, q = deformed(seed)
    along = np.random.default_rng(300 + seed).standard_normal(len(q))
    gradient, by_jax, hessian, change = derivatives(state, q, jnp.asarray(along))
    size, stiffest = float(jnp.abs(gradient).max()), float(jnp.abs(hessian).max())
    np.testing.assert_allclose(gradient, by_jax, atol=1e-13 * size)
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-14 * stiffest)
    np.testing.assert_allclose(hessian @ along, change, atol=1e-13 * stiffest)


@pytest.mark.parametrize("seed", SEEDS)
def test_energies_are_those_of_the_shape_reached(seed):
    """The energy that a step sees at its end is that of a rod whose frames were carried there."""
    state, q = deformed(seed)
    there = carry(ROD, state, q)
    np.testing.assert_allclose(energies(state, q), energies(there, there.q), rtol=1e-11)


@pytest.fixture(scope="module", params=SEEDS)
def case(request):
    """Gradients before and after a motion of the whole world, and that motion."""
    state, q = deformed(request.param)
    rng = np.random.default_rng(100 + request.param)
    turn = rotation(rng.standard_normal(3), rng.uniform(0, 3))
    shift = rng.standard_normal(3)
    moved = replace(
        state,
        q=act(state.q, turn, shift),
        velocity=act(state.velocity, turn, jnp.zeros(3)),
        reference_director=state.reference_director @ turn.T,
    )
    before = all_gradients(state, q, jnp.eye(3))
    return before, all_gradients(moved, act(q, turn, shift), turn), turn


@pytest.mark.parametrize("name", TERMS)
def test_forces_turn_with_the_body_and_do_not_care_where_it_is(case, name):
    before, after, turn = case
    expected = act(before[name], turn, jnp.zeros(3))
    size = float(jnp.abs(expected).max())
    assert size > 0.01  # there is something to compare
    np.testing.assert_allclose(after[name], expected, atol=1e-12 * size + 1e-11)


@pytest.mark.parametrize("seed", SEEDS)
def test_reference_frames_are_a_matter_of_choice(seed):
    """Other directors, with angles and reference twists to match, give the same forces."""
    state, q = deformed(seed)
    choice = np.random.default_rng(200 + seed).uniform(-1, 1, ROD.topology.n_edges)
    tangent = tangents(ROD.topology, positions(ROD.topology, state.q))
    director = state.reference_director
    turned = np.cos(choice)[:, None] * director + np.sin(choice)[:, None] * np.cross(
        tangent, director
    )
    shift = np.concatenate([np.zeros(3 * N_NODES), choice])
    other = replace(
        state,
        q=state.q - shift,
        reference_director=jnp.asarray(turned),
        reference_twist=state.reference_twist + np.diff(choice),
    )
    here = all_gradients(state, q, jnp.eye(3))
    there = all_gradients(other, q - shift, jnp.eye(3))
    for name in TERMS:
        size = float(jnp.abs(here[name]).max())
        np.testing.assert_allclose(there[name], here[name], atol=1e-12 * size, err_msg=name)


def test_drag_on_a_turning_head_is_that_of_its_angular_velocity():
    """Spinning about its axis and tilting, each with its own resistance, in a rigid rotation."""
    state, _ = deformed(0)
    omega = np.array([0.3, -0.5, 0.4])
    x = positions(ROD.topology, state.q)
    step = 1e-5  # so short that a chord is an arc
    angle = step * np.linalg.norm(omega)
    turned = (x - x[0]) @ rotation(omega, angle).T + x[0]
    axis = np.asarray(tangents(ROD.topology, x)[0])
    edge_angles = angles(ROD.topology, state.q).at[0].add(step * omega @ axis)
    q = jnp.concatenate([turned.ravel(), edge_angles])
    head = DRAG["head"]
    gradient = jax.jit(lambda x: share(head, ROD, state, step).gradient(x))(q)
    assert float(gradient[3 * N_NODES]) == pytest.approx(float(head.spin) * omega @ axis, rel=1e-4)
    force = positions(ROD.topology, gradient)[1]
    moment = np.cross(x[1] - x[0], force)
    across = omega - (omega @ axis) * axis
    np.testing.assert_allclose(moment, float(head.tilt) * across, rtol=1e-4)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", ELASTIC)
def test_internal_forces_have_no_resultant(name, seed):
    """Nor a moment: that of the nodal forces and of the torques along the edges."""
    state, _ = deformed(seed)
    gradient = all_gradients(state, state.q, jnp.eye(3))[name]
    x, force = positions(ROD.topology, state.q), positions(ROD.topology, gradient)
    size = np.abs(gradient).max()
    np.testing.assert_allclose(np.sum(force, axis=0), 0.0, atol=1e-13 * size)
    torque = angles(ROD.topology, gradient) @ tangents(ROD.topology, x)
    moment = np.sum(np.cross(x, force), axis=0) + torque
    np.testing.assert_allclose(moment, 0.0, atol=1e-12 * size)


@pytest.mark.parametrize("name", [n for n in DRAG if n != "RSS, lagged"])
def test_a_body_at_rest_feels_no_drag(name):
    state, q = deformed(0)
    moving = np.abs(all_gradients(state, q, jnp.eye(3))[name]).max()
    at_rest = np.abs(all_gradients(state, state.q, jnp.eye(3))[name]).max()
    assert at_rest < 1e-13 * moving


@pytest.mark.parametrize("name", ["RSS", "RSS, full weight", "RSS, lower triangle", "RFT", "head"])
def test_drag_is_a_symmetric_matrix_that_only_dissipates(name):
    """On the degrees of freedom it acts on; also for a rod that is anything but straight."""
    state, _ = deformed(1)
    contribution = jax.jit(share)(TERMS[name], ROD, state, 0.1)
    matrix = np.asarray(jax.jit(lambda part, q: assemble([part]).hessian(q))(contribution, state.q))
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-13 * np.abs(matrix).max())
    acted_on = np.unique(contribution.dofs.array)
    smallest = np.linalg.eigvalsh(matrix[acted_on][:, acted_on])[0]
    if name == "head":  # does not resist stretching its own edge
        assert smallest > -1e-12
    else:
        assert smallest > 0.1


def test_collocation_is_not_quite_symmetric():
    """A coarse filament, bent at random, is off by a tenth."""
    state, _ = deformed(1)
    x = positions(ROD.topology, state.q)
    matrix = np.asarray(jax.jit(TERMS["RSS, collocation"].resistance)(x))
    symmetric = np.asarray(jax.jit(TERMS["RSS"].resistance)(x))
    np.testing.assert_allclose(0.5 * (matrix + matrix.T), symmetric, atol=1e-12 * matrix.max())
    asymmetry = np.linalg.norm(matrix - matrix.T) / np.linalg.norm(matrix)
    assert 0.05 < asymmetry < 0.2
    assert not TERMS["RSS, collocation"].symmetric
    assert TERMS["RSS"].symmetric


def test_drag_doubles_with_the_speed_and_with_the_viscosity():
    state, q = deformed(2)
    term = TERMS["RSS"]
    ahead = state.q + 2 * (q - state.q)
    once = potential(ROD, state, (term,), STEP).gradient(q)
    twice = potential(ROD, state, (term,), STEP).gradient(ahead)
    thicker = replace(term, viscosity=2 * term.viscosity)
    slow = potential(ROD, state, (thicker,), STEP).gradient(q)
    np.testing.assert_allclose(twice, 2 * once, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(slow, 2 * once, rtol=1e-10, atol=1e-12)


# Labels --------------------------------------------------------------------------------------


@partial(jax.jit, static_argnums=0)
def strained(topology, nodes, moved, spin):
    """Energy, forces on nodes and torques on edges of a rod that was `nodes` at rest."""
    rod, state = rest(topology, nodes)
    q = jnp.concatenate([moved.ravel(), spin])
    total = potential(rod, state, elasticity(rod, ea=100.0))
    gradient = total.gradient(q)
    return total.value(q), positions(topology, gradient), angles(topology, gradient)


@pytest.mark.parametrize("seed", SEEDS)
def test_direction_of_edges_and_order_of_hinges_do_not_matter(seed):
    """Edges listed backwards, and hinges from the other side, are the same rod.

    An edge that is listed backwards has its angle, and its torque, the other way round.
    """
    rng = np.random.default_rng(seed)
    nodes = np.array(helix(0.1, 0.6, 1.0, N, "left"))
    moved = nodes + 0.02 * rng.standard_normal(nodes.shape)
    spin = 0.3 * rng.standard_normal(N)
    plain = strained(chain(N + 1), nodes, moved, spin)

    backwards = np.array([1, 2, 5, 6, 9])  # the first keeps its direction, and its director
    flipped = np.array([0, 3, 4, 7, 10])
    sign = np.ones(N)
    sign[backwards] = -1
    edges = tuple((i + 1, i) if i in backwards else (i, i + 1) for i in range(N))
    hinges = tuple((i + 1, i) if i in flipped else (i, i + 1) for i in range(N - 1))
    energy, force, torque = strained(Topology(N + 1, edges, hinges), nodes, moved, sign * spin)
    assert float(energy) == pytest.approx(float(plain[0]), rel=1e-12)
    np.testing.assert_allclose(force, plain[1], atol=1e-11 * np.abs(plain[1]).max())
    np.testing.assert_allclose(sign * torque, plain[2], atol=1e-11 * np.abs(plain[1]).max())


def test_numbering_of_nodes_and_edges_does_not_matter(rng):
    nodes = np.array(helix(0.1, 0.6, 1.0, N, "left"))
    moved = nodes + 0.02 * rng.standard_normal(nodes.shape)
    spin = 0.3 * rng.standard_normal(N)
    plain = strained(chain(N + 1), nodes, moved, spin)
    new_node, new_edge = rng.permutation(N + 1), np.append(0, 1 + rng.permutation(N - 1))
    edges = [(0, 0)] * N
    for i in range(N):
        edges[new_edge[i]] = (int(new_node[i]), int(new_node[i + 1]))
    hinges = tuple((int(new_edge[i]), int(new_edge[i + 1])) for i in range(N - 1))
    old_node, old_edge = np.argsort(new_node), np.argsort(new_edge)
    topology = Topology(N + 1, tuple(edges), hinges)
    energy, force, torque = strained(topology, nodes[old_node], moved[old_node], spin[old_edge])
    assert float(energy) == pytest.approx(float(plain[0]), rel=1e-12)
    np.testing.assert_allclose(force[new_node], plain[1], atol=1e-11 * np.abs(plain[1]).max())
    np.testing.assert_allclose(torque[new_edge], plain[2], atol=1e-11 * np.abs(plain[1]).max())


def test_a_joint_of_three_filaments_has_no_net_force(rng):
    """Three rods that meet at one node, with edges that point towards and away from it."""
    edges = ((0, 1), (1, 2), (3, 1), (4, 3), (2, 5))
    hinges = ((0, 1), (0, 2), (2, 3), (1, 4), (1, 2))
    nodes = rng.standard_normal((6, 3))
    moved = nodes + 0.1 * rng.standard_normal((6, 3))
    spin = 0.3 * rng.standard_normal(5)
    energy, force, _ = strained(Topology(6, edges, hinges), nodes, moved, spin)
    assert float(energy) > 0.1
    np.testing.assert_allclose(np.sum(force, axis=0), 0.0, atol=1e-12 * np.abs(force).max())
    rest_energy, rest_force, rest_torque = strained(
        Topology(6, edges, hinges), nodes, nodes, np.zeros(5)
    )
    assert float(rest_energy) < 1e-20
    np.testing.assert_allclose(rest_force, 0.0, atol=1e-11 * np.abs(force).max())
    np.testing.assert_allclose(rest_torque, 0.0, atol=1e-11 * np.abs(force).max())
