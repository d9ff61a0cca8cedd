"""Robots at rest: where their nodes lie, what is joined to what, and what their files may say."""

import itertools
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import potential, rotation

from derjax import InputError, Scene, SceneFile, State, Topology, build, load_scene, positions
from derjax.core.pytree import replace
from derjax.rods.head import (
    head_angle,
    head_angular_velocity,
    head_axis,
    head_of,
    head_position,
    head_spin,
)
from derjax.rods.rod import no_history
from derjax.shapes import (
    RobotGeometry,
    arc,
    branched,
    clamped,
    edge_count,
    helix,
    helix_contour,
    rotated_about_x,
    single_flagellum,
    two_flagella,
)
from derjax.terms import Bend, HeadDrag, Twist

RADIUS, PITCH, LENGTH = 6.4e-3, 44.5e-3, 95.4e-3
SEPARATION = 28e-3
N = 9
EDGE = float(helix_contour(RADIUS, PITCH, LENGTH)) / N
CHORD = float(np.linalg.norm(np.diff(helix(RADIUS, PITCH, LENGTH, N, "left"), axis=0)[0]))


def coil(handedness: str = "left", phase: float = 0.0):
    return rotated_about_x(phase, helix(RADIUS, PITCH, LENGTH, N, handedness))


def make(kind: str, filaments: list) -> RobotGeometry:
    """A robot of some kind with these filaments."""
    edge, separation = jnp.asarray(EDGE), jnp.asarray(SEPARATION)
    if kind == "single_flagellum":
        (filament,) = filaments
        return single_flagellum(filament, edge)
    if kind == "two_flagella":
        first, second = filaments
        return two_flagella((first, second), edge, separation)
    return {"branched": branched, "clamped": clamped}[kind](filaments, edge, separation)


MANY = [("two_flagella", 2)] + [(k, m) for k in ("branched", "clamped") for m in range(2, 9)]
KINDS = [("single_flagellum", 1), ("branched", 1), ("clamped", 1), *MANY]
WITH_HEAD = [(kind, count) for kind, count in KINDS if kind != "clamped"]
every_kind = pytest.mark.parametrize(("kind", "count"), KINDS)
with_head = pytest.mark.parametrize(("kind", "count"), WITH_HEAD)

_bodies: dict[tuple[str, int], RobotGeometry] = {}


def body_of(kind: str, count: int) -> RobotGeometry:
    """The robot with equal left-handed helices."""
    if (kind, count) not in _bodies:
        _bodies[kind, count] = make(kind, [coil()] * count)
    return _bodies[kind, count]


def mirrored(nodes) -> np.ndarray:
    """The image in the plane y = 0, between two flagella."""
    return np.asarray(nodes) * [1.0, -1.0, 1.0]


def edge_between(topology: Topology, a: int, b: int) -> int:
    """The edge that joins two nodes, whichever way it points."""
    (found,) = [e for e, ends in enumerate(topology.edges) if set(ends) == {a, b}]
    return found


def lengths(body: RobotGeometry) -> np.ndarray:
    start, end = body.topology.edge_nodes.T
    return np.linalg.norm(np.asarray(body.nodes)[end] - np.asarray(body.nodes)[start], axis=1)


# Geometry ------------------------------------------------------------------------------------


@every_kind
def test_number_of_nodes_and_edges(kind, count):
    """Each flagellum has N + 1 nodes on its helix; shafts, links and heads add the others."""
    own = {"single_flagellum": 4, "two_flagella": 7, "branched": 2 + 3 * count, "clamped": 2}[kind]
    if count == 1:
        own = {"single_flagellum": 4, "branched": 4, "clamped": 2}[kind]
    elif kind == "clamped":
        own = 2 * count
    body = body_of(kind, count)
    assert body.topology.n_nodes == own + count * (N + 1)
    assert body.nodes.shape == (body.topology.n_nodes, 3)
    pieces = count if kind == "clamped" else 1
    assert body.topology.n_edges == body.topology.n_nodes - pieces  # trees
    assert len(body.topology.filaments) == count
    assert sorted({n for edge in body.topology.edges for n in edge}) == list(
        range(body.topology.n_nodes)
    )


@every_kind
def test_edges_that_should_be_equal_are(kind, count):
    body = body_of(kind, count)
    length, topology = lengths(body), body.topology
    seen = set()
    for path in topology.filaments:
        along = [edge_between(topology, a, b) for a, b in itertools.pairwise(path)]
        shaft, step_out, *turns = along
        assert length[shaft] == pytest.approx(EDGE, rel=1e-12)
        assert length[step_out] == pytest.approx(RADIUS, rel=1e-12)  # from the axis to the helix
        np.testing.assert_allclose(length[turns], CHORD, rtol=1e-12)
        assert len(turns) == N
        seen |= set(along)
    rest = np.delete(length, list(seen))
    if kind == "two_flagella":  # link, bar, bar, link
        np.testing.assert_allclose(rest, [EDGE, *[SEPARATION / 2] * 2, EDGE], rtol=1e-12)
    elif kind == "clamped":
        assert len(rest) == 0
    elif count == 1:
        np.testing.assert_allclose(rest, EDGE, rtol=1e-12)  # head and link
    else:
        out = SEPARATION / 2 / math.sin(math.pi / count)
        np.testing.assert_allclose(rest[0], EDGE, rtol=1e-12)  # the head
        np.testing.assert_allclose(rest[1::2], out, rtol=1e-12)  # arms
        np.testing.assert_allclose(rest[2::2], EDGE, rtol=1e-12)  # links


@every_kind
def test_flagella_lie_along_x_and_neighbours_are_the_separation_apart(kind, count):
    body = body_of(kind, count)
    nodes = np.asarray(body.nodes)
    axes = []
    for path in body.topology.filaments:
        shaft_start, shaft_end, *rest = nodes[list(path)]
        np.testing.assert_allclose(shaft_end - shaft_start, [EDGE, 0, 0], atol=1e-15)
        np.testing.assert_allclose(shaft_start[0], 0.0, atol=1e-16)
        away = np.array(rest) - shaft_start
        np.testing.assert_allclose(np.hypot(away[:, 1], away[:, 2]), RADIUS, rtol=1e-12)
        np.testing.assert_allclose(away[:, 0], EDGE + LENGTH * np.linspace(0, 1, N + 1), rtol=1e-12)
        axes.append(shaft_start[1:])
    if count == 1:
        np.testing.assert_allclose(axes[0], 0.0, atol=1e-16)
        return
    gaps = [np.linalg.norm(a - b) for a, b in zip(axes, axes[1:] + axes[:1], strict=True)]
    np.testing.assert_allclose(gaps, SEPARATION, rtol=1e-12)
    between = [np.linalg.norm(a - b) for a, b in itertools.combinations(axes, 2)]
    assert min(between) > SEPARATION * (1 - 1e-12)  # neighbours are the nearest
    np.testing.assert_allclose(np.mean(axes, axis=0), 0.0, atol=1e-16)


@pytest.mark.parametrize("handedness", ["left", "right"])
def test_handedness(handedness):
    """A right-handed helix turns clockwise as it goes away: a positive triple product."""
    nodes = np.asarray(helix(RADIUS, PITCH, LENGTH, 40, handedness))
    a, b, c = np.diff(nodes, axis=0)[:3]
    assert np.sign(np.dot(np.cross(a, b), c)) == {"left": -1, "right": 1}[handedness]
    whole_turn = np.asarray(helix(RADIUS, PITCH, PITCH, 40, handedness))
    np.testing.assert_allclose(whole_turn[-1] - whole_turn[0], [PITCH, 0, 0], atol=1e-16)


def test_length_of_a_helix():
    fine = np.diff(helix(RADIUS, PITCH, LENGTH, 20_000, "left"), axis=0)
    contour = float(helix_contour(RADIUS, PITCH, LENGTH))
    assert np.linalg.norm(fine, axis=1).sum() == pytest.approx(contour, rel=1e-7)


@pytest.mark.parametrize("size", [4.9e-3, 5e-3, 20e-3, 1.0])
def test_edges_are_as_short_as_the_file_allows(size):
    n = edge_count(RADIUS, PITCH, LENGTH, size)
    contour = float(helix_contour(RADIUS, PITCH, LENGTH))
    if n > 3:
        assert contour / n >= size > contour / (n + 1)
    else:
        assert n == 3
    assert edge_count(RADIUS, PITCH, LENGTH, contour / 7) == 7  # in spite of round-off


@pytest.mark.parametrize("kind", ["two_flagella", "branched", "clamped"])
def test_opposite_flagella_are_mirror_images(kind):
    """With phases that are opposite, too: a phase turns a flagellum, and a mirror reverses it."""
    first, second = coil("left", 0.7), coil("right", np.pi - 0.7)
    body = make(kind, [first, second])
    nodes = np.asarray(body.nodes)
    one, other = (nodes[list(path)] for path in body.topology.filaments)
    np.testing.assert_allclose(mirrored(one), other, atol=1e-16)
    assert np.abs(one[:, 1] - other[:, 1]).min() > SEPARATION - 2 * RADIUS - 1e-9
    if kind == "two_flagella":
        np.testing.assert_allclose(mirrored(nodes)[::-1], nodes, atol=1e-16)
    same = np.asarray(make(kind, [coil("left", 0.7), coil("left", -0.7)]).nodes)
    one, other = (same[list(path)] for path in body.topology.filaments)
    assert np.abs(mirrored(one) - other).max() > 0.1 * RADIUS


@pytest.mark.parametrize("kind", ["branched", "clamped"])
@pytest.mark.parametrize("count", range(2, 9))
def test_equal_flagella_are_copies_around_the_axis(kind, count):
    """Shifted, so that those of one phase are in phase in space."""
    body = make(kind, [coil("right", 0.4)] * count)
    nodes = np.asarray(body.nodes)
    own = (len(nodes) - 2) // count if kind == "branched" else len(nodes) // count
    hub, branches = np.split(nodes, [len(nodes) - own * count])
    branches = branches.reshape(count, own, 3)
    shift = branches[:, :1] - [0, 0, 0]
    np.testing.assert_allclose(
        branches - shift, np.tile((branches - shift)[0], (count, 1, 1)), atol=1e-15
    )
    turn = np.asarray(rotation([1, 0, 0], 2 * np.pi / count))
    np.testing.assert_allclose(shift[:, 0] @ turn.T, np.roll(shift[:, 0], -1, axis=0), atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(shift[1] - shift[0]), SEPARATION, rtol=1e-12)
    np.testing.assert_allclose(hub @ turn.T, hub, atol=1e-16)
    # ... and so are the edges and the hinges, but for the numbers of the nodes.
    paths = np.array(body.topology.filaments)
    np.testing.assert_array_equal(np.diff(paths, axis=0), own)


def test_two_flagella_are_copies():
    body = make("two_flagella", [coil("right", 0.4)] * 2)
    first, second = (np.asarray(body.nodes)[list(path)] for path in body.topology.filaments)
    np.testing.assert_allclose(
        second - first, np.tile([0, SEPARATION, 0], (len(first), 1)), atol=1e-16
    )


def test_in_antiphase_two_flagella_are_images_under_half_a_turn():
    nodes = np.asarray(make("two_flagella", [coil("right", 0.4 + np.pi), coil("right", 0.4)]).nodes)
    turn = np.asarray(rotation([1, 0, 0], np.pi))
    np.testing.assert_allclose((nodes @ turn.T)[::-1], nodes, atol=1e-16)


def test_one_rod_and_two_branches_have_the_same_flagella():
    """The first of the branched robot, at y > 0, is the second of the one rod."""
    filaments = [coil("left", 0.3), coil("right", 1.1)]
    one_rod, branches = make("two_flagella", filaments[::-1]), make("branched", filaments)
    for a, b in zip(one_rod.topology.filaments[::-1], branches.topology.filaments, strict=True):
        np.testing.assert_allclose(
            one_rod.nodes[np.array(a)], branches.nodes[np.array(b)], atol=1e-16
        )


def test_one_branch_is_the_robot_with_one_flagellum():
    one, other = body_of("single_flagellum", 1), body_of("branched", 1)
    assert one.topology == other.topology
    np.testing.assert_array_equal(one.nodes, other.nodes)
    assert one.stiff_hinges == other.stiff_hinges == ()


def test_no_flagella_are_too_few():
    with pytest.raises(ValueError, match="at least one"):
        make("branched", [])


@pytest.mark.parametrize("bend", [0.0, 0.8, -2.0, 2 * np.pi])
def test_arcs(bend):
    """Equal edges that turn by `bend` in all, half of an edge's share before the first."""
    n = 40
    nodes = np.asarray(arc(LENGTH, bend, n))
    edges = np.diff(np.vstack([np.zeros(3), nodes]), axis=0)
    np.testing.assert_allclose(np.linalg.norm(edges, axis=1), LENGTH / n, rtol=1e-12)
    heading = np.unwrap(np.arctan2(edges[:, 1], edges[:, 0]))
    np.testing.assert_allclose(np.diff(heading), bend / n, atol=1e-13)
    assert heading[0] == pytest.approx(bend / n / 2, abs=1e-13)
    assert heading[-1] + bend / n / 2 == pytest.approx(bend, abs=1e-12)
    np.testing.assert_allclose(nodes[:, 2], 0.0)
    chord = LENGTH * abs(np.sinc(bend / 2 / np.pi))  # of a circular arc
    assert np.linalg.norm(nodes[-1]) == pytest.approx(chord, rel=2e-3, abs=1e-9)
    if bend == 0:
        np.testing.assert_allclose(nodes[:, 1], 0.0)


# Topology ------------------------------------------------------------------------------------


@every_kind
def test_filaments_go_from_the_motor_outwards(kind, count):
    body = body_of(kind, count)
    nodes, topology = np.asarray(body.nodes), body.topology
    for path in topology.filaments:
        for a, b in itertools.pairwise(path):
            edge_between(topology, a, b)  # there is one, and only one
        x = nodes[list(path), 0]
        assert x[0] == pytest.approx(0.0, abs=1e-16)
        assert x[-1] == pytest.approx(EDGE + LENGTH)
        assert (np.diff(x) > -1e-15).all()
        ends = [n for n in path if sum(n in edge for edge in topology.edges) == 1]
        assert path[-1] in ends
    of_all = [n for path in topology.filaments for n in path]
    assert len(set(of_all)) == len(of_all)
    others = set(range(topology.n_nodes)) - set(of_all)
    assert len(others) == (0 if kind == "clamped" else topology.n_nodes - count * (N + 3))


@every_kind
def test_every_edge_hangs_on_one_hinge(kind, count):
    """Hinges make trees, and their edges run outwards: no sign is negative."""
    topology = body_of(kind, count).topology
    np.testing.assert_array_equal(topology.hinge_signs, 1.0)
    hung = [second for _, second in topology.hinges]
    assert len(set(hung)) == len(hung)
    roots = set(range(topology.n_edges)) - set(hung)
    assert len(roots) == (count if kind == "clamped" else 1)
    for middle, (first, second) in zip(topology.hinge_nodes[:, 1], topology.hinges, strict=True):
        assert topology.edges[first][1] == middle == topology.edges[second][0]


@with_head
def test_motors_drive_the_shafts_against_the_links(kind, count):
    """Where the filament begins, and all of them in the same sense: with the right hand about x."""
    body = body_of(kind, count)
    topology, nodes = body.topology, np.asarray(body.nodes)
    assert topology.driven_edges == topology.fixed_dofs == ()
    assert len(topology.motors) == count
    for motor, path in zip(topology.motors, topology.filaments, strict=True):
        first, second = topology.hinges[motor]
        before, middle, after = topology.hinge_nodes[motor]
        assert middle == path[0]
        shaft = edge_between(topology, path[0], path[1])
        assert shaft in (first, second)
        link = second if shaft == first else first
        assert not set(topology.edges[link]) <= set(path)
        # The natural twist turns the second edge against the first, about the hinge's direction.
        direction = nodes[after] - nodes[before]
        np.testing.assert_allclose(direction[1:], 0.0, atol=1e-16)  # straight, along x
        sense = np.sign(direction[0]) * (1 if shaft == second else -1)
        assert sense == 1


@pytest.mark.parametrize("count", [1, 2, 5])
def test_spindles_are_the_clamped_shafts(count):
    topology = body_of("clamped", count).topology
    assert topology.motors == ()
    assert topology.head is None
    assert len(topology.driven_edges) == count
    held = set()
    for spindle, path in zip(topology.driven_edges, topology.filaments, strict=True):
        assert topology.edges[spindle] == path[:2]
        held |= {3 * node + axis for node in path[:2] for axis in range(3)}
        held.add(3 * topology.n_nodes + spindle)
    assert set(topology.fixed_dofs) == held
    assert len(topology.fixed_dofs) == 7 * count


@with_head
def test_stiff_hinges_are_those_of_the_head(kind, count):
    """Where a head has arms: at all of its own nodes, and at none of the motors."""
    body = body_of(kind, count)
    topology = body.topology
    middles = [topology.hinge_nodes[h][1] for h in body.stiff_hinges]
    assert not set(body.stiff_hinges) & set(topology.motors)
    head = head_of(topology)
    if count == 1:
        assert middles == []
    elif kind == "two_flagella":
        assert sorted(middles) == [head.line[0], head.node, head.line[1]]
    else:
        assert middles.count(1) == count  # of the arms on the hub
        assert len(middles) == 2 * count
        corners = set(middles) - {1}
        radii = np.linalg.norm(np.asarray(body.nodes)[list(corners), 1:], axis=1)
        np.testing.assert_allclose(radii, SEPARATION / 2 / math.sin(math.pi / count), rtol=1e-12)
        np.testing.assert_allclose(np.asarray(body.nodes)[list(corners), 0], -EDGE, rtol=1e-12)


# How a head moves ----------------------------------------------------------------------------


def moved(body: RobotGeometry, turns: list[np.ndarray], omega: np.ndarray) -> State:
    """Rigid rotations of a robot, one after the other, each turning at the rate `omega`."""
    topology, x = body.topology, np.asarray(body.nodes)
    start, end = topology.edge_nodes.T
    frames = []
    for turn in turns:
        there = x @ turn.T
        tangent = there[end] - there[start]
        tangent /= np.linalg.norm(tangent, axis=1)[:, None]
        rate = np.concatenate([np.cross(omega, there).ravel(), tangent @ omega])
        frames.append((np.concatenate([there.ravel(), np.zeros(topology.n_edges)]), rate))
    q, velocity = (jnp.asarray(np.stack(each)) for each in zip(*frames, strict=True))
    n, e, b = len(turns), topology.n_edges, len(topology.hinges)
    k = len(topology.motors)
    zeros = [jnp.zeros((n, *shape)) for shape in ((e, 3), (b,), (k,), (k,), (k,), (e,), ())]
    return State(q, velocity, jnp.zeros_like(q), *zeros, no_history(q))


@pytest.mark.parametrize(
    ("kind", "count"), [("single_flagellum", 1), ("two_flagella", 2), ("branched", 3)]
)
def test_the_motion_of_a_head(kind, count):
    """All of its angular velocity, whatever its direction; and its axis points to the flagella."""
    body = body_of(kind, count)
    omega = np.array([0.5, -0.8, 0.3])
    turns = [np.eye(3), np.asarray(rotation([1.0, 2.0, -0.5], 2.0))]
    states = moved(body, turns, omega)
    topology = body.topology
    head = np.asarray(body.nodes)[head_of(topology).node]
    np.testing.assert_allclose(
        head_position(topology, states), [t @ head for t in turns], atol=1e-15
    )
    axis = head_axis(topology, states)
    np.testing.assert_allclose(axis, [t[:, 0] for t in turns], atol=1e-14)
    rate = head_angular_velocity(topology, states)
    np.testing.assert_allclose(rate, [omega, omega], atol=1e-13)
    np.testing.assert_allclose(head_spin(topology, states), axis @ omega, atol=1e-13)


def test_the_angle_of_a_head_that_is_a_bar():
    """It goes on counting past half a turn."""
    body = body_of("two_flagella", 2)
    angle = np.linspace(0.0, 12.0, 25)
    tilted = np.asarray(rotation([0.0, 1.0, 1.0], 0.9))
    turns = [tilted @ np.asarray(rotation([1.0, 0, 0], a)) for a in angle]
    states = moved(body, turns, np.zeros(3))
    np.testing.assert_allclose(head_angle(body.topology, states), angle, atol=1e-12)


def test_clamped_filaments_have_no_head():
    body = body_of("clamped", 1)
    with pytest.raises(ValueError, match="no head"):
        head_position(body.topology, moved(body, [np.eye(3)], np.zeros(3)))


# Scenes --------------------------------------------------------------------------------------


def scene_of(**robot) -> SceneFile:
    """A coarse robot in a vacuum, whose flagella pass through each other: quick to compile."""
    return SceneFile.model_validate(
        {
            "robot": {"edge_length": 30e-3, **robot},
            "fluid": {"hydrodynamics": "none"},
            "head": {"drag": "none"},
            "contact": {"method": "none"},
            "time": {"inertia": False},
        }
    )


AT_REST = {
    "single": scene_of(),
    "one rod": scene_of(kind="two_flagella", phase=[0.3, -1.0], handedness=["left", "right"]),
    "three": scene_of(kind="branched", n_flagella=3, pitch=31.8e-3),
    "arcs": scene_of(kind="branched", n_flagella=2, shape="arc", bend=1.5),
    "clamped": scene_of(kind="clamped", n_flagella=1, shape="straight"),
}


@jax.jit
def force_at_rest(scene: Scene, state: State):
    """Elastic forces and torques in units of the solver's."""
    return potential(scene.rod, state, scene.terms).gradient(state.q) / scene.newton.force_scale


@pytest.fixture(scope="module")
def built():
    scenes = {name: build(file) for name, file in AT_REST.items()}
    return {name: (scene, scene.start) for name, scene in scenes.items()}


@pytest.mark.parametrize("name", AT_REST)
def test_no_force_at_rest(built, name):
    """Though a little more natural curvature would be felt."""
    scene, state = built[name]
    assert np.abs(force_at_rest(scene, state)).max() < 1e-8
    bent = replace(
        scene, rod=replace(scene.rod, natural_curvature=scene.rod.natural_curvature + 0.1)
    )
    assert np.abs(force_at_rest(bent, state)).max() > 1.0


@pytest.mark.parametrize("name", AT_REST)
def test_scenes_are_made_of_the_robots_of_their_files(built, name):
    """Phase, handedness and number of every flagellum, in the order of the file."""
    file, (scene, state) = AT_REST[name], built[name]
    nodes = np.asarray(positions(scene.rod.topology, state.q))
    robot, paths = file.robot, scene.rod.topology.filaments
    assert len(paths) == robot.count
    assert len(state.motor_angle) == robot.count
    assert scene.motor is not None
    assert scene.motor.rate.shape == (1, robot.count)
    for path, hand, phase in zip(paths, robot.hands, robot.phases, strict=True):
        x = nodes[list(path)] - nodes[path[0]]
        x = np.asarray(rotated_about_x(-phase, x))
        if robot.shape == "helix":
            n = len(path) - 3
            edge = helix_contour(robot.helix_radius, robot.pitch, robot.axial_length) / n
            own = helix(robot.helix_radius, robot.pitch, robot.axial_length, n, hand)
        else:
            n = len(path) - 2
            edge, own = robot.axial_length / n, arc(robot.axial_length, robot.bend, n)
        np.testing.assert_allclose(x[2:], own + np.array([edge, 0, 0]), atol=1e-15)


def test_only_the_arms_of_a_head_are_stiffer(built):
    for name, stiff in (("single", 0), ("one rod", 3), ("three", 6), ("clamped", 0)):
        scene, _ = built[name]
        for term in scene.terms:
            if isinstance(term, Bend | Twist):
                relative = np.asarray(term.stiffness) / np.min(term.stiffness)
                assert np.count_nonzero(relative > 1) == stiff
                np.testing.assert_allclose(relative[relative > 1], 100.0)


# Files ---------------------------------------------------------------------------------------


def complaint(tmp_path: Path, text: str, table: str | None = None) -> str:
    path = tmp_path / "robot.toml"
    path.write_text(text)
    if table is not None:
        (tmp_path / "motor.csv").write_text(table)
    with pytest.raises(InputError) as caught:
        load_scene(path)
    said = str(caught.value)
    assert said.startswith(f"{path}: ")
    return said.removeprefix(f"{path}: ")


TWO = "[robot]\nkind = 'two_flagella'\n"
THREE = "[robot]\nkind = 'branched'\nn_flagella = 3\n"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[robot]\nkind = 'branched'", "[robot] n_flagella: must be given"),
        ("[robot]\nkind = 'clamped'", "[robot] n_flagella: must be given"),
        (f"{TWO}n_flagella = 3", "[robot] n_flagella = 3: a robot of kind 'two_flagella' has 2"),
        ("[robot]\nn_flagella = 2", "[robot] n_flagella = 2: a robot of kind 'single_flagellum'"),
        ("[robot]\nkind = 'branched'\nn_flagella = 0", "[robot] n_flagella = 0: should be greater"),
        ("[robot]\nkind = 'branched'\nn_flagella = 9", "[robot] n_flagella = 9: at most 8"),
        ("[robot]\nkind = 'branched'\nn_flagella = 2.5", "[robot] n_flagella = 2.5: should be"),
        ("[robot]\nkind = 'branched'\nn_flagella = '2'", '[robot] n_flagella = "2": should be'),
        ("[robot]\nkind = 'clamped'\nn_flagella = 65", "[robot] n_flagella = 65: should be less"),
        (f"{TWO}handedness = ['left']", "[robot] handedness: 1 given for 2 flagella"),
        (f"{TWO}phase = [0, 1, 2]", "[robot] phase: 3 given for 2 flagella"),
        ("[robot]\nphase = []", "[robot] phase: 0 given for 1 flagellum"),
        (f"{THREE}phase = [0, 1]", "[robot] phase: 2 given for 3 flagella"),
        (f"{THREE}[motor]\nrpm = [60, 30]", "[motor] rpm: 2 rates given for 3 flagella"),
        ("[motor]\nrpm = [60, 30]", "[motor] rpm: 2 rates given for 1 flagellum"),
        (f"{TWO}[motor]\nrpm = [60, 2e6]", "[motor] rpm = 2e+06: beyond any motor"),
        (f"{TWO}separation = 3e-3", "[robot] separation = 0.003: the flagella overlap"),
        (f"{TWO}separation = 28", "[robot] separation = 28: lengths are in metres"),
        (f"{TWO}bend = 1", "[robot] bend = 1: is only for shape = 'arc'"),
        (f"{TWO}[head]\nrotation = 'spin'", "[head] rotation = 'spin': the head of kind"),
        (f"{TWO}[friction]\n[contact]\nmethod = 'none'", "[friction]: needs a [contact] method"),
        ("[friction]", "[friction]: needs a [contact] method"),
        (
            f"{TWO}[friction]\n[contact]\nmethod = 'spillmann_teschner'",
            "[friction]: is not part of [contact]",
        ),
        (f"{TWO}[friction]\ncoefficient = -1", "[friction] coefficient = -1: should be greater"),
        (f"{TWO}[contact]\nmethod = 'soft'", '[contact] method = "soft": should be'),
        (f"{TWO}[contact]\ncapacity = 0", "[contact] capacity = 0: should be greater"),
        (f"{THREE}[fluid]\nhead_nodes = 'dropped'", "[fluid] head_nodes = 'dropped': not for"),
    ],
)
def test_complaints_are_one_line_that_names_file_and_key(tmp_path, text, expected):
    said = complaint(tmp_path, text)
    assert said.startswith(expected)
    assert "\n" not in said


@pytest.mark.parametrize(
    "text",
    [
        "[robot]\nhandedness = 'lefty'",
        f"{TWO}handedness = ['left', 'rigth']",
        f"{TWO}phase = [0, 'x']",
        "[motor]\nrpm = 'fast'",
        "[motor]\nrpm = true",
    ],
)
def test_complaints_about_keys_that_take_a_value_or_a_list(tmp_path, text):
    said = complaint(tmp_path, text)
    assert "\n" not in said
    assert "tuple" not in said
    assert "float" not in said


@pytest.mark.parametrize(
    "text",
    [
        f"{TWO}n_flagella = 2",
        f"{TWO}[friction]\ncoefficient = 0\n[contact]\nmethod = 'none'",
        f"{TWO}[motor]\nrpm = 30",
        f"{TWO}[motor]\nrpm = [30]",
        f"{TWO}handedness = ['left', 'right']\nphase = [0, 1]\n[motor]\nrpm = [30, -20]",
        "[robot]\nkind = 'branched'\nn_flagella = 1\n[head]\nrotation = 'spin'",
        f"{THREE}[head]\nrotation = 'spin'",
    ],
)
def test_what_is_accepted(tmp_path, text):
    path = tmp_path / "robot.toml"
    path.write_text(text)
    load_scene(path)


TABLE = f"{TWO}[motor]\ntable = 'motor.csv'\n[time]\nend = 2\n"


def test_a_table_with_a_column_for_every_motor(tmp_path):
    (tmp_path / "robot.toml").write_text(TABLE + "step = 0.5\n")
    (tmp_path / "motor.csv").write_text("time, rpm_2, rpm_1\n0, 5, 0\n2, 5, 60\n")
    file = load_scene(tmp_path / "robot.toml")
    np.testing.assert_array_equal(file.parameters["rpm"], [[0.0, 5.0], [60.0, 5.0]])
    scene = build(file)
    assert scene.motor is not None
    turned = scene.motor.rotation(jnp.asarray(0.0), jnp.asarray(2.0))
    np.testing.assert_allclose(turned, 2 * np.pi / 60 * np.array([60.0, 10.0]), rtol=1e-12)


def test_a_table_with_one_column_for_all_motors(tmp_path):
    (tmp_path / "robot.toml").write_text(TABLE + "step = 0.5\n")
    (tmp_path / "motor.csv").write_text("time, rpm\n0, 0\n2, 60\n")
    scene = build(load_scene(tmp_path / "robot.toml"))
    assert scene.motor is not None
    turned = scene.motor.rotation(jnp.asarray(0.5), jnp.asarray(1.5))
    np.testing.assert_allclose(turned, 2 * np.pi / 60 * np.array([30.0, 30.0]), rtol=1e-12)


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ("time,rpm_1\n0,1\n2,1\n", "no column 'rpm_2'; the columns are 'time', 'rpm_1'"),
        ("time,speed\n0,1\n2,1\n", "no column 'rpm_1' or 'rpm_2'"),
        ("rpm_1,rpm_2\n0,1\n2,1\n", "no column 'time'"),
        ("time,rpm_1,rpm_2\n0,1,1\n2,1,\n", "line 3, column 'rpm_2': has no number"),
        ("time,rpm_1,rpm_2\n0,1,-2e6\n2,1,1\n", "line 2: rpm = 2e+06: beyond any motor"),
        ("time,rpm_1,rpm_2\n0,1,1\n1,1,1\n", "the motor table covers 0 to 1 s, but"),
        ("time,rpm_1,rpm_2\n0,1,1\n0,1,1\n2,1,1\n", "line 3: times must increase"),
    ],
)
def test_complaints_about_tables_for_several_motors(tmp_path, table, expected):
    said = complaint(tmp_path, TABLE, table)
    assert said.startswith(f"[motor] table: {tmp_path / 'motor.csv'}: {expected}")
    assert "\n" not in said


def test_the_published_arm_is_part_of_the_rotational_drag():
    """A force at half the separation, for a torque over the head's radius: its square."""
    robot = {"kind": "two_flagella", "edge_length": 30e-3}
    exact, published = (
        build(SceneFile.model_validate({"robot": robot, "head": {"arm": arm}}))[HeadDrag]
        for arm in ("exact", "published")
    )
    np.testing.assert_allclose(published.tilt / exact.tilt, (0.5 * 28e-3 / 31e-3) ** 2)
    np.testing.assert_array_equal(published.spin, published.tilt)
    np.testing.assert_array_equal(published.translation, exact.translation)
