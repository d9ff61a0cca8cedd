"""Robots with several flagella in motion: symmetries, balances, and what their motors do.

All robots are coarse, so that they are quick to compile. Those of one kind share one compiled
program, in which contact and friction are present whether or not anything touches.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import acting, potential, rotation

from derjax import RolloutStats, Scene, SceneFile, State, angles, build, march_frames, positions
from derjax.core.pytree import replace
from derjax.rods.head import head_angular_velocity, head_axis, head_of, head_position, head_spin
from derjax.rods.kinematics import material_directors, tangents
from derjax.rods.vectors import parallel_transport, signed_angle
from derjax.terms import HeadDrag, StokesletSegments
from derjax.terms.contact.neighbours import PENETRATION
from derjax.terms.contact.repulsion import Contact
from derjax.terms.contact.segments import distance

RPM = 60.0
RATE = RPM * 2 * np.pi / 60
STEP = 1e-2
N_STEPS = 200
LISTED = {"capacity": 120}
"""Contacts: flagella side by side come close with more pairs of edges than usual robots."""
MOTION = jax.jit(partial(march_frames, n_frames=N_STEPS, steps_per_frame=1))
"""Two seconds, every step."""


class Run(NamedTuple):
    """A scene, where it started, and its states after every step."""

    file: SceneFile
    scene: Scene
    start: State
    states: State
    report: RolloutStats


def scene_file(kind: str, rpm, robot: dict | None = None, **tables) -> SceneFile:
    """Two flagella, inertialess, with contact and friction, solved to round-off.

    In antiphase, images of each other under half a turn, if nothing else is said.
    """
    phase = [np.pi, 0.0] if kind == "two_flagella" else [0.0, np.pi]
    shape = {"kind": kind, "edge_length": 10e-3, "pitch": 31.8e-3, "phase": phase, **(robot or {})}
    if kind != "two_flagella":
        shape = {"n_flagella": 2, **shape}
    content = {
        "robot": shape,
        "motor": {"rpm": rpm},
        "time": {"step": STEP, "end": N_STEPS * STEP, "scheme": "euler", "inertia": False},
        "friction": {},
        "contact": LISTED,
        "solver": {"tolerance": 1e-12},
        **tables,
    }
    return SceneFile.model_validate(content)


def follow(file: SceneFile, start: State | None = None) -> Run:
    scene = build(file)
    state = scene.start
    start = state if start is None else start
    states, report = MOTION(scene, start)
    report.raise_if_failed()
    return Run(file, scene, start, states, report)


@pytest.fixture(scope="module")
def equal() -> Run:
    """One rod, both flagella alike and turned alike."""
    return follow(scene_file("two_flagella", RPM))


@pytest.fixture(scope="module")
def unequal() -> Run:
    """One rod without any symmetry: motors that turn against each other, and shapes askew."""
    return follow(scene_file("two_flagella", [60.0, -30.0], {"phase": [np.pi + 0.4, 1.5]}))


@pytest.fixture(scope="module")
def touching() -> Run:
    """One rod whose flagella are so close that they come to touch."""
    robot = {"separation": 14.5e-3, "phase": [np.pi, 0.5]}
    return follow(scene_file("two_flagella", RPM, robot, contact=LISTED | {"stiffness": 1e4}))


@pytest.fixture(scope="module")
def branches() -> Run:
    """A head with two branches, both flagella alike and turned alike."""
    return follow(scene_file("branched", RPM))


def nodes_of(run: Run) -> np.ndarray:
    """(t, n, 3) m."""
    return np.asarray(positions(run.scene.rod.topology, run.states.q))


def speed(run: Run) -> float:
    """Slope of the head's x over the second half of the run, m/s."""
    x = np.asarray(head_position(run.scene.rod.topology, run.states))[:, 0]
    half = N_STEPS // 2
    return float(np.polyfit(np.asarray(run.states.time)[half:], x[half:], 1)[0])


def contacts(run: Run) -> np.ndarray:
    """How many pairs of edges overlap after every step."""
    (term,) = (t for t in run.scene.terms if isinstance(t, Contact))
    ends = run.scene.rod.topology.edge_nodes[term.pairs.array].reshape(-1, 4)
    gaps = np.asarray(jax.jit(distance)(nodes_of(run)[:, ends]))
    assert gaps.min() > (1 - PENETRATION) * 2 * float(term.radius)
    return np.sum(gaps < 2 * float(term.radius), axis=1)


# Other ways to say the same ------------------------------------------------------------------


def test_one_branch_swims_as_the_robot_with_one_flagellum():
    """It is the same scene, number for number, and therefore the same motion.

    Up to round-off: the two are built by different programs.
    """
    robots = [{"kind": "single_flagellum"}, {"kind": "branched", "n_flagella": 1}]
    common = {"fluid": {"hydrodynamics": "rft"}, "motor": {"rpm": 40}}  # RFT: quick to compile
    scenes = [
        build(SceneFile.model_validate({"robot": {"edge_length": 20e-3, **robot}, **common}))
        for robot in robots
    ]
    one, other = (replace(scene, source=None) for scene in scenes)  # their files differ
    assert jax.tree.structure(one) == jax.tree.structure(other)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-13, atol=1e-15), one, other)
    (first, _), (second, _) = (MOTION(each, each.start) for each in (one, other))
    assert np.abs(first.q[-1] - one.start.q).max() > 1e-4
    np.testing.assert_allclose(second.q, first.q, atol=1e-10)


@pytest.mark.slow
def test_one_rod_and_two_branches_swim_alike(equal, branches):
    """Their heads differ in how they are made, and their stiff arms hardly bend."""
    assert speed(equal) < -1e-4
    assert speed(branches) == pytest.approx(speed(equal), rel=0.01)
    spins = [float(np.mean(head_spin(r.scene.rod.topology, r.states))) for r in (equal, branches)]
    assert spins[1] == pytest.approx(spins[0], rel=0.01)
    assert spins[0] < 0 < RATE  # the head turns against the flagella
    for run in (equal, branches):
        assert contacts(run).max() == 0


# Symmetries of the robot ---------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", ["equal", pytest.param("branches", marks=pytest.mark.slow)])
def test_equal_flagella_do_not_drift_sideways(name, request):
    """By the two-fold symmetry the head stays on its axis, and so does that."""
    run = request.getfixturevalue(name)
    topology = run.scene.rod.topology
    head = np.asarray(head_position(topology, run.states))
    assert np.ptp(head[:, 0]) > 1e-3
    assert np.abs(head[:, 1:]).max() < 1e-12
    assert np.abs(np.asarray(head_axis(topology, run.states))[:, 1:]).max() < 1e-10
    half_turn = np.asarray(rotation([1, 0, 0], np.pi))
    one, other = (nodes_of(run)[:, list(path)] for path in topology.filaments)
    assert np.abs(one - other @ half_turn.T).max() < 1e-12


@pytest.mark.slow
def test_opposite_flagella_do_not_turn_the_head():
    """Mirror images that are turned oppositely stay so: the head can pitch, but not roll."""
    mirror = {"handedness": ["left", "right"]}
    run = follow(scene_file("two_flagella", [RPM, -RPM], mirror))
    topology = run.scene.rod.topology
    rate = np.asarray(head_angular_velocity(topology, run.states))
    assert np.abs(rate[:, [0, 2]]).max() < 1e-6 * RATE
    assert np.abs(rate[:, 1]).max() > 1e-3 * RATE
    image = nodes_of(run)[:, ::-1] * [1.0, -1.0, 1.0]
    assert np.abs(nodes_of(run) - image).max() < 1e-10
    # Whereas two that are turned alike cannot both be driven without the head turning.
    alike = follow(scene_file("two_flagella", [RPM, RPM], mirror))
    assert np.abs(head_angular_velocity(topology, alike.states)[:, 0]).min() > 1e-2 * RATE


@pytest.mark.slow
def test_the_image_of_a_swimmer_is_a_swimmer(unequal):
    """Right-handed flagella turned the other way: the mirror image of the whole motion.

    In the plane y = 0, which takes the one flagellum to the other one's place.
    """
    robot = {"phase": [np.pi - 1.5, -0.4], "handedness": "right"}
    image = follow(scene_file("two_flagella", [30.0, -60.0], robot))
    expected = nodes_of(unequal)[:, ::-1] * [1.0, -1.0, 1.0]
    moved = np.abs(expected - expected[0]).max()
    assert moved > 1e-3
    np.testing.assert_allclose(nodes_of(image), expected, atol=1e-8 * moved)


# Symmetries of space -------------------------------------------------------------------------


def placed(run: Run, turn, shift) -> State:
    """The start of a run, elsewhere."""
    topology = run.scene.rod.topology
    state = run.start
    x = positions(topology, state.q) @ turn.T + shift
    v = positions(topology, state.velocity) @ turn.T
    return replace(
        state,
        q=jnp.concatenate([x.ravel(), angles(topology, state.q)]),
        velocity=jnp.concatenate([v.ravel(), angles(topology, state.velocity)]),
        reference_director=state.reference_director @ turn.T,
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["unequal", pytest.param("touching", marks=pytest.mark.slow)])
def test_where_a_swimmer_starts_and_heads_for_does_not_matter(name, request):
    """Neither in Stokes flow nor in contact; nor can it be told from the angles."""
    run = request.getfixturevalue(name)
    if name == "touching":
        assert np.count_nonzero(contacts(run)) > N_STEPS // 10
    turn, shift = rotation([1.0, -2.0, 0.5], 2.2), np.array([0.3, -0.2, 0.1])
    moved = follow(run.file, placed(run, turn, shift))
    expected = nodes_of(run) @ np.asarray(turn).T + shift
    size = np.abs(nodes_of(run) - nodes_of(run)[0]).max()
    assert size > 1e-3
    np.testing.assert_allclose(nodes_of(moved), expected, atol=1e-6 * size)
    topology = run.scene.rod.topology
    np.testing.assert_allclose(
        angles(topology, moved.states.q), angles(topology, run.states.q), atol=1e-6
    )


@pytest.mark.slow
def test_in_a_vacuum_only_differences_of_velocity_count():
    """Without drag a robot that is thrown moves as one at rest, and onwards."""
    file = scene_file(
        "two_flagella",
        [60.0, -30.0],
        fluid={"hydrodynamics": "none"},
        head={"drag": "none"},
        contact={"method": "none"},
        friction=None,
        time={"step": STEP, "end": N_STEPS * STEP},
    )
    still = follow(file)
    topology = still.scene.rod.topology
    wind = np.array([0.1, -0.03, 0.02])
    thrown = jnp.concatenate([jnp.tile(wind, topology.n_nodes), jnp.zeros(topology.n_edges)])
    moving = follow(file, replace(still.start, velocity=still.start.velocity + thrown))
    times = np.asarray(still.states.time)[:, None, None]
    tip = nodes_of(still)[:, 0]
    assert np.abs(tip - tip[0]).max() > 5e-3  # it does move
    np.testing.assert_allclose(nodes_of(moving), nodes_of(still) + times * wind, atol=1e-9)
    # Its momentum stays zero, as nothing pushes.
    mass = next(t.mass for t in still.scene.terms if hasattr(t, "mass"))
    momentum = positions(topology, jnp.asarray(mass) * still.states.velocity).sum(axis=1)
    parts = positions(topology, jnp.asarray(mass) * still.states.velocity)
    assert np.abs(momentum).max() < 1e-8 * np.abs(parts).max()


# Motors --------------------------------------------------------------------------------------


def total_turn(run: Run, first: int, second: int) -> np.ndarray:
    """Angle (rad) by which the material of one edge has turned against that of another.

    Measured from the frames, about the direction of the second edge, and counted on.
    """
    topology = run.scene.rod.topology

    def angle(state: State):
        tangent = tangents(topology, positions(topology, state.q))
        theta = angles(topology, state.q)
        material, _ = material_directors(state.reference_director, tangent, theta)
        carried = parallel_transport(material[first], tangent[first], tangent[second])
        return signed_angle(carried, material[second], tangent[second])

    start = float(angle(run.start))
    return np.unwrap(np.concatenate([[start], jax.vmap(angle)(run.states)]))[1:] - start


@pytest.mark.slow
def test_each_motor_turns_its_own_flagellum(unequal):
    """At its own rate and in its own direction, about x, but for the twist of the shaft."""
    topology, times = unequal.scene.rod.topology, np.asarray(unequal.states.time)
    for motor, rpm, path in zip(topology.motors, (60.0, -30.0), topology.filaments, strict=True):
        first, second = topology.hinges[motor]
        shaft = first if set(topology.edges[first]) == set(path[:2]) else second
        link = second if shaft == first else first
        turned = total_turn(unequal, link, shaft)
        if topology.edges[shaft][0] != path[0]:  # the edge points to the head, against x
            turned = -turned
        wanted = rpm * 2 * np.pi / 60 * times
        elastic = turned - wanted
        assert np.abs(elastic).max() < 0.5 < 0.1 * np.abs(wanted).max()
        assert np.sign(elastic[-1]) == -np.sign(rpm)  # it lags behind


# Drag of the head ----------------------------------------------------------------------------

HEADS = {
    "one rod": {"kind": "two_flagella"},
    "two branches": {"kind": "branched", "n_flagella": 2},
    "one flagellum": {"kind": "single_flagellum"},
}


@pytest.mark.parametrize("name", HEADS)
def test_drag_of_a_head_is_that_of_its_velocities(name):
    """Exactly, however long the step.

    Whatever their direction: -6 pi mu r_h C_t u and -8 pi mu r_h^3 C_r omega.
    """
    file = SceneFile.model_validate(
        {
            "robot": {"edge_length": 30e-3, "head_radius": 0.02, **HEADS[name]},
            "head": {"rotation": "full", "C_t": 2.5, "C_r": 0.7},
            "fluid": {"viscosity": 1.7, "hydrodynamics": "none"},
            "contact": {"method": "none"},
            "time": {"inertia": False},
        }
    )
    scene = build(file)
    state = scene.start
    topology = scene.rod.topology
    turn = np.asarray(rotation([1.0, 2.0, 3.0], 1.1))  # no direction is special
    x = positions(topology, state.q) @ turn.T
    start = jnp.concatenate([x.ravel(), angles(topology, state.q)])
    state = replace(state, q=start, reference_director=state.reference_director @ turn.T)
    head = head_of(topology)
    drags = tuple(t for t in scene.terms if isinstance(t, HeadDrag))

    def rates(velocity, omega):
        nodes = velocity + jnp.cross(omega, x - x[head.node])
        return jnp.concatenate([nodes.ravel(), tangents(topology, x) @ omega])

    @jax.jit
    def load(velocity, omega, step):
        """Force and torque (about the head node) of the drag in a step of rigid motion."""
        total = potential(scene.rod, state, drags, step)
        value = lambda u, w: total.value(start + step * rates(u, w)) / step  # noqa: E731
        return [-g for g in jax.grad(value, argnums=(0, 1))(velocity, omega)]

    u, omega = jnp.array([0.01, -0.02, 0.005]), jnp.array([0.4, 0.3, -0.6])
    translation = 6 * np.pi * 1.7 * 0.02 * 2.5
    rotational = 8 * np.pi * 1.7 * 0.02**3 * 0.7
    force, torque = load(u, jnp.zeros(3), 0.01)
    np.testing.assert_allclose(force, -translation * u, rtol=1e-12)
    np.testing.assert_allclose(torque, 0.0, atol=1e-15)
    force, torque = load(u, omega, 1e-6)
    np.testing.assert_allclose(force, -translation * u, rtol=1e-9)
    moving = replace(state, velocity=rates(u, omega))
    seen = head_angular_velocity(topology, jax.tree.map(lambda leaf: leaf[None], moving))[0]
    np.testing.assert_allclose(seen, omega, rtol=1e-12)
    np.testing.assert_allclose(torque, -rotational * seen, rtol=1e-5)
    for step in (2e-2, 1e-2):
        np.testing.assert_allclose(load(u, omega, step)[1], -rotational * omega, rtol=1e-9)


# Balances ------------------------------------------------------------------------------------


@jax.jit
def drag_gradient(rod, state, terms, step, q):
    return potential(rod, state, terms, step).gradient(q)


def drag_forces(run: Run, kind: type, k: int) -> np.ndarray:
    """Force (N) on nodes and torque (N m) on edges by one kind of drag in step k."""
    before = jax.tree.map(lambda leaf: leaf[k - 1], run.states)
    q = before.q + STEP * run.states.velocity[k]  # whole turns not taken out
    terms = acting(run.scene, before, kind)
    return -np.asarray(drag_gradient(run.scene.rod, before, terms, run.scene.step_length, q))


def total_load(run: Run, load: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Force, and moment about the origin, of a load at the end of step k.

    A torque on an angle counts along (t0 + t1) / (1 + t0 . t1): turning the whole rod by a
    small w turns an angle that is measured from a frame transported from t0 to t1 by that much.
    """
    topology = run.scene.rod.topology
    old, new = nodes_of(run)[k - 1], nodes_of(run)[k]
    t0, t1 = (np.asarray(tangents(topology, x)) for x in (old, new))
    along = (t0 + t1) / (1 + np.sum(t0 * t1, axis=1, keepdims=True))
    force = load[: 3 * topology.n_nodes].reshape(-1, 3)
    moment = np.cross(new, force).sum(axis=0) + load[3 * topology.n_nodes :] @ along
    return force.sum(axis=0), moment


@pytest.mark.parametrize(
    "name", ["equal", *(pytest.param(n, marks=pytest.mark.slow) for n in ("unequal", "branches"))]
)
def test_swimming_is_free_of_force_and_torque(name, request):
    """What the fluid does to the flagella and to the head adds up to nothing."""
    run = request.getfixturevalue(name)
    for k in (20, N_STEPS - 1):
        head, fluid = (drag_forces(run, kind, k) for kind in (HeadDrag, StokesletSegments))
        parts, sums = total_load(run, head, k), total_load(run, head + fluid, k)
        assert np.linalg.norm(parts[0]) > 1e-5  # N
        assert np.linalg.norm(parts[1]) > 1e-6  # N m
        sizes = [np.abs(fluid).max(), np.abs(total_load(run, fluid, k)[1]).max()]
        for total, part, size in zip(sums, parts, sizes, strict=True):
            np.testing.assert_allclose(total, 0.0, atol=1e-8 * max(size, np.abs(part).max()))


# Clamped filaments ---------------------------------------------------------------------------


def clamped(rpm, modulus: float = 1.255e6) -> SceneFile:
    material, contact = {"youngs_modulus": modulus}, {"method": "none"}
    return scene_file("clamped", rpm, material=material, friction=None, contact=contact)


@pytest.fixture(scope="module")
def held() -> Run:
    """Two filaments on motors that turn against each other."""
    return follow(clamped([45.0, -30.0]))


def test_clamped_bases_stay_where_they_are(held):
    topology = held.scene.rod.topology
    bases = [node for path in topology.filaments for node in path[:2]]
    start = np.asarray(positions(topology, held.start.q))[bases]
    np.testing.assert_array_equal(nodes_of(held)[:, bases], np.broadcast_to(start, (N_STEPS, 4, 3)))
    tips = nodes_of(held)[:, [path[-1] for path in topology.filaments]]
    assert np.abs(tips - tips[0]).max() > 1e-3


def test_clamped_bases_turn_by_the_angles_of_their_motors(held):
    topology = held.scene.rod.topology
    times = np.asarray(held.states.time)
    turned = angles(topology, held.states.q) + 2 * np.pi * held.states.turns
    for spindle, rpm in zip(topology.driven_edges, (45.0, -30.0), strict=True):
        expected = rpm * 2 * np.pi / 60 * times
        np.testing.assert_allclose(turned[:, spindle], expected, rtol=1e-12)
        # ... and the helix follows, about x: its first node goes round the shaft.
        path = topology.filaments[topology.driven_edges.index(spindle)]
        away = nodes_of(held)[:, path[2]] - nodes_of(held)[:, path[1]]
        followed = np.unwrap(np.arctan2(away[:, 2], away[:, 1]))
        np.testing.assert_allclose(followed - followed[0], expected - expected[0], atol=0.5)


def thrust(run: Run, k: int = N_STEPS - 1) -> float:
    """Force (N) along x of the fluid on the flagella."""
    return float(total_load(run, drag_forces(run, StokesletSegments, k), k)[0][0])


def rigid_thrust(run: Run) -> float:
    """What it would be if they turned as rigid bodies about the axes of their motors."""
    topology, nodes = run.scene.rod.topology, nodes_of(run)[-1]
    velocity = np.zeros_like(nodes)
    rates = np.broadcast_to(run.file.motor.rates, 2) * 2 * np.pi / 60
    for path, rate in zip(topology.filaments, rates, strict=True):
        path = list(path)
        velocity[path] = np.cross([rate, 0.0, 0.0], nodes[path] - nodes[path[0]])
    (term,) = (t for t in run.scene.terms if isinstance(t, StokesletSegments))
    order = [n for path in topology.filaments for n in path]
    force = -np.asarray(jax.jit(term.resistance)(jnp.asarray(nodes))) @ velocity[order].ravel()
    return float(force.reshape(-1, 3)[:, 0].sum())


@pytest.mark.slow
def test_thrust_of_clamped_filaments_has_the_sign_of_a_screw():
    """Left-handed helices turned with the right hand about x are pulled against x.

    That is, towards the head that they would push. Stiff ones that turn slowly hardly deform;
    that there are two of them makes thrust depend a little on how far they have turned.
    """
    forwards, backwards = (follow(clamped(rpm, modulus=1.255e8)) for rpm in (10.0, -10.0))
    assert thrust(forwards) < -1e-4  # N
    assert thrust(backwards) == pytest.approx(-thrust(forwards), rel=0.05)
    for run in (forwards, backwards):
        assert thrust(run) == pytest.approx(rigid_thrust(run), rel=0.005)
