"""Motors of limited torque: their line, their work, and what they tend to."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import derjax as dj
from derjax.core.pytree import replace
from derjax.integrate.motor import Motor
from derjax.results.mechanics import motor_angles, motor_rates, motor_torques
from derjax.rods.kinematics import angles
from derjax.scenes.file import SceneFile
from derjax.terms.motor import Drive, Hinge, shaft_angle, shaft_energy
from derjax.terms.term import Role, contributions, standing

TURN = 2 * np.pi / 60
STALL, FREE = 4e-4, 100.0
"""N m and rpm: such a motor turns the robot below at some 60 rpm."""


def scene_file(kind="single_flagellum", motor=None, **tables):
    """A short flagellum of few nodes, with a motor that its load slows down."""
    robot = {"kind": kind, "axial_length": 0.06, "edge_length": 8e-3}
    if kind == "clamped":
        robot["n_flagella"] = 1
    motor = {"stall_torque": STALL, "free_rpm": FREE} if motor is None else motor
    times = {"end": 0.4, "frame": 0.1} | tables.pop("time", {})
    robot |= tables.pop("robot", {})
    return SceneFile.from_dict({"robot": robot, "motor": motor, "time": times, **tables})


RUNS: dict[tuple, dj.Run] = {}


def run_of(kind="single_flagellum", scheme="trbdf2", **options):
    key = kind, scheme, str(options)
    if key not in RUNS:
        time = {"scheme": scheme} | options.pop("time", {})
        scene = dj.build(scene_file(kind, time=time, **options))
        RUNS[key] = dj.rollout(scene, reverse_mode=False)
        RUNS[key].raise_if_failed()
    return RUNS[key]


@pytest.mark.parametrize(
    ("kind", "scheme"),
    [
        pytest.param("single_flagellum", "trbdf2", marks=pytest.mark.slow),
        ("clamped", "euler"),
    ],
)
def test_the_torque_that_is_passed_on_is_that_of_the_motor(kind, scheme):
    """To round-off in every state, by the stored energy and by the drag."""
    run = run_of(kind, scheme)
    states = jax.tree.map(lambda leaf: leaf[1:], run.states)
    rate = motor_rates(run.scene, states)
    line = STALL * (1.0 - rate / (FREE * TURN))
    np.testing.assert_allclose(motor_torques(run.scene, states), line, rtol=2e-6)
    assert 0.3 * FREE * TURN < float(rate[-1, 0]) < 0.95 * FREE * TURN


def test_a_motor_on_a_straight_shaft_turns_as_fast_as_its_drag_allows():
    """T_0 (1 - w / w_0) = 4 pi mu r^2 L w: a closed form."""
    file = scene_file(
        "clamped",
        {"stall_torque": 2e-5, "free_rpm": 600.0},
        robot={"shape": "straight", "rod_radius": 4e-3, "edge_length": 0.01},
        fluid={"hydrodynamics": "rft", "spin_drag": True},
        time={"end": 1.0, "frame": 0.5, "scheme": "trbdf2"},
    )
    scene = dj.build(file)
    run = dj.rollout(scene, reverse_mode=False)
    run.raise_if_failed()
    # The drag of the edges: the first one is held in place and turns, too.
    spins = angles(scene.rod.topology, run.states.velocity)[-1]
    length = jnp.sum(scene.rod.rest_length)
    drag = 4 * np.pi * scene.number("viscosity") * 4e-3**2 * float(length)
    free = 600.0 * TURN
    expected = 2e-5 / (drag + 2e-5 / free)
    assert float(drag) * free > 2e-6  # slows it down
    np.testing.assert_allclose(spins, expected, rtol=1e-6)
    np.testing.assert_allclose(run.states.motor_rate[-1], expected, rtol=1e-6)


def works(scene, state):
    """Power (W) of the motors, and of all drag and inertia, and the stored energy (J)."""
    chosen = [term for term in scene.terms if term.role is not Role.ENERGY]
    stage = dj.integrate.step.moving_stage(scene, state, state.velocity, state.acceleration)
    drag = sum(
        part.gradient(state.q) @ state.velocity
        for part in contributions(chosen, scene.rod, state, stage, standing(state, scene.terms))
    )
    shaft = scene.motor.torque(state.motor_angle, state.motor_rate) @ state.motor_rate
    return shaft, drag, sum(dj.energies(scene, state).values())


POWERS = jax.jit(jax.vmap(works, (None, 0)))


RIPPLED = {"stall_torque": STALL, "free_rpm": 2.0 * FREE, "ripple": 0.3, "ripple_order": 3}


def rippled(step):
    """A run of a motor with ripple, of 20 steps of some length (s), all kept."""
    time = {"end": 20 * step, "frame": step, "step": step, "scheme": "trbdf2"}
    return run_of(motor=RIPPLED, scheme="trbdf2", time=time)


def test_work_of_the_shaft_is_dissipated_or_stored():
    """And kinetic energy, at second order: 1/4 of the difference for half the step."""
    left = []
    for step in (0.02, 0.01):  # as many of them, so that programs are shared
        run = rippled(step)
        shaft, drag, stored = POWERS(run.scene, run.states)
        part = slice(round(0.1 / step), round(0.2 / step) + 1)  # the start has died out
        paid, kept = np.trapezoid(shaft[part], dx=step), stored[part]
        spent = np.trapezoid(drag[part], dx=step) + kept[-1] - kept[0]
        left.append(abs(float(paid - spent)) / float(paid))
    assert left[1] < 3e-3
    assert 1.6 < np.log2(left[0] / left[1]) < 2.6, left


@pytest.mark.slow
def test_a_strong_motor_turns_at_its_rate():
    """It slips by its load over its stall torque."""
    prescribed = run_of(motor={"rpm": 60.0})
    torque = float(motor_torques(prescribed.scene, prescribed.states)[-1, 0])
    for strength in (100.0, 200.0):
        run = run_of(motor={"stall_torque": strength * torque, "free_rpm": 60.0})
        rate = float(run.states.motor_rate[-1, 0])
        np.testing.assert_allclose(1.0 - rate / (60.0 * TURN), 1.0 / strength, rtol=0.03)


@pytest.mark.slow
def test_backwards_is_the_mirror_image():
    time = {"scheme": "trbdf2"}  # as other tests have it
    right = scene_file(robot={"handedness": "right"}, time=time)
    back = scene_file(motor={"stall_torque": STALL, "free_rpm": -FREE}, time=time)
    first, second = (dj.rollout(dj.build(f), reverse_mode=False) for f in (right, back))
    np.testing.assert_allclose(first.states.motor_rate, -second.states.motor_rate, rtol=1e-9)
    np.testing.assert_allclose(
        first.head_position[:, 0], second.head_position[:, 0], rtol=1e-9, atol=1e-15
    )


@pytest.mark.slow
def test_derivatives_in_both_modes():
    """Of a step in which the motor starts."""
    motor = {"stall_torque": STALL, "free_rpm": FREE, "ripple": 0.2, "ripple_order": 3}
    tables = {"fluid": {"hydrodynamics": "rft"}, "solver": {"tolerance": 1e-9}}  # for differences
    scene = dj.build(scene_file(motor=motor, **tables))
    names = ("stall_torque", "free_rate", "ripple")
    at = jnp.concatenate([getattr(scene.motor, name) for name in names])

    @jax.jit
    def end(values):
        motor = replace(scene.motor, **{n: v[None] for n, v in zip(names, values, strict=True)})
        state = scene.scheme(replace(scene, motor=motor), scene.start, jnp.asarray(0.05)).state
        return jnp.stack([state.motor_angle[0], 1e3 * state.q[-1 - scene.rod.topology.n_edges]])

    forward, reverse = jax.jit(jax.jacfwd(end))(at), jax.jit(jax.jacrev(end))(at)
    np.testing.assert_allclose(forward * at, reverse * at, rtol=1e-9, atol=1e-12)
    for k in range(len(names)):
        h = 1e-4 * at[k]
        high, low = (end(at.at[k].add(sign * h)) for sign in (1, -1))
        wanted = (high - low) / (2 * h)
        np.testing.assert_allclose(forward[:, k] * at[k], wanted * at[k], rtol=1e-5, atol=1e-8)


def test_the_angle_of_a_shaft_is_where_torques_balance():
    """With ripple and bending; its derivatives, to second order, are those of that place."""
    hinge = Hinge(jnp.array(1.2e-3), jnp.array(8e-4))
    drive = Drive(*(jnp.array(x) for x in (5e-4, 0.3, 1.1, 4e-5, 4.0)))
    kappa = jnp.array([0.3, -0.2])

    def angle(twist):
        return shaft_angle(kappa, twist, hinge, drive)

    found = angle(0.25)
    slope = jax.grad(shaft_energy)(found, kappa, 0.25, hinge, drive)
    assert abs(float(slope)) < 1e-17
    assert float(jax.grad(jax.grad(shaft_energy))(found, kappa, 0.25, hinge, drive)) > 0.0
    h = 1e-3
    near = [float(angle(0.25 + k * h)) for k in (-2, -1, 0, 1, 2)]
    first = (near[0] - 8 * near[1] + 8 * near[3] - near[4]) / (12 * h)
    second = (-near[0] + 16 * near[1] - 30 * near[2] + 16 * near[3] - near[4]) / (12 * h**2)
    np.testing.assert_allclose(jax.grad(angle)(0.25), first, rtol=1e-9)
    np.testing.assert_allclose(jax.grad(jax.grad(angle))(0.25), second, rtol=1e-5)


def test_ripple_of_a_rate_is_integrated_exactly():
    motor = Motor(
        jnp.array([0.0, 1.0]),
        jnp.array([[2.0, 5.0], [6.0, 1.0]]),
        ripple=jnp.array([0.3, 0.1]),
        ripple_order=jnp.array([4.0, 7.0]),
    )
    time = jnp.linspace(0.2, 1.7, 3001)
    rates = motor.rate_at(time)
    dt = float(time[1] - time[0])
    simpson = dt / 3 * (rates[0] + 4 * rates[1:-1:2].sum(0) + 2 * rates[2:-1:2].sum(0) + rates[-1])
    np.testing.assert_allclose(motor.rotation(time[0], time[-1]), simpson, rtol=1e-9)


def test_ripple_of_a_torque_shows_in_its_rate():
    run = rippled(0.02)
    states = jax.tree.map(lambda leaf: leaf[1:], run.states)
    angle, rate = motor_angles(run.scene, states)[:, 0], motor_rates(run.scene, states)[:, 0]
    assert np.all(np.diff(angle) > 0)
    assert angle[-1] > 1.2 * np.pi  # and yet every angle is within half a turn
    assert np.all(np.abs(run.states.motor_angle) <= np.pi + 1e-12)
    torque = STALL * (1.0 - rate / (2.0 * FREE * TURN) + 0.3 * np.sin(3 * angle))
    np.testing.assert_allclose(motor_torques(run.scene, states)[:, 0], torque, rtol=2e-6)
    wave = np.exp(-3j * angle)
    assert abs(np.mean((rate - rate.mean()) * wave)) > 0.05 * float(rate.mean())


@pytest.mark.slow
def test_every_motor_has_a_torque_of_its_own():
    file = scene_file(
        "two_flagella",
        {"stall_torque": [STALL, 2 * STALL], "free_rpm": [FREE, -FREE]},
        fluid={"hydrodynamics": "rft"},  # quick to compile
        contact={"method": "none"},
    )
    run = dj.rollout(dj.build(file), reverse_mode=False)
    run.raise_if_failed()
    rate, torque = run.states.motor_rate[-1], motor_torques(run.scene, run.states)[-1]
    assert rate[0] > 0.0 > rate[1]
    assert -rate[1] > rate[0]
    line = np.array([STALL, 2 * STALL]) * (np.array([1, -1]) - rate / (FREE * TURN))
    np.testing.assert_allclose(torque, line, rtol=2e-6)
    written = run.to_dataset()
    np.testing.assert_allclose(written.motor_torque[-1], line, rtol=2e-6)
    np.testing.assert_allclose(written.motor_rate[-1], rate)


@pytest.mark.parametrize("find", [dj.steady, dj.orbit])
def test_what_needs_constant_rates_says_so(find):
    with pytest.raises(dj.InputError, match=r"\[motor\] stall_torque"):
        find(dj.build(scene_file()))


BAD = [
    ({"rpm": 60.0, "stall_torque": 1e-3, "free_rpm": 60.0}, "either rpm or stall_torque, not both"),
    ({"stall_torque": 1e-3}, "free_rpm: must be given"),
    ({"free_rpm": 60.0}, "stall_torque: must be given (N m)"),
    ({"stall_torque": -1e-3, "free_rpm": 60.0}, "[motor] stall_torque"),
    ({"stall_torque": 40.0, "free_rpm": 60.0}, "did you mean 0.04?"),
    ({"stall_torque": 1e-3, "free_rpm": 0.0}, "such a motor cannot start"),
    ({"stall_torque": 1e-3, "free_rpm": 60.0, "ripple": 1.5}, "cannot start from every angle"),
    ({"stall_torque": [1e-3, 1e-3], "free_rpm": 60.0}, "stall_torque: 2 values given for 1 flag"),
    ({"stall_torque": 1e-3, "free_rpm": 60.0, "hinge": "published"}, "hinge that goes limp"),
    ({"stall_torque": 1e-3, "free_rpm": 1e7}, "free_rpm = 1e+07: beyond any motor"),
]


@pytest.mark.parametrize(("motor", "said"), BAD, ids=[said for _, said in BAD])
def test_bad_motors_are_refused(motor, said):
    with pytest.raises(dj.InputError) as caught:
        SceneFile.from_dict({"motor": motor})
    assert said in str(caught.value)
    assert "[motor]" in str(caught.value)
