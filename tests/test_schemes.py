"""Schemes: what they do to linear motion, to the order of the robot's path, and adaptive steps."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import advance, order

from derjax import (
    RolloutStats,
    Scene,
    SceneFile,
    SolverError,
    State,
    Status,
    at_rest,
    build,
    chain,
    march_frames,
    positions,
    roll_frames,
)
from derjax.core.pytree import pytree, replace
from derjax.integrate.frames import new_stats
from derjax.integrate.schemes.euler import euler
from derjax.integrate.schemes.trbdf2 import D, trbdf2
from derjax.integrate.step_size import StepSizeController
from derjax.rods import head as kinematics
from derjax.rods.rod import Rod
from derjax.solve.contributions import Contribution, Diagonal
from derjax.solve.newton import NewtonSettings
from derjax.terms import Inertia, Stage, Term

N_DOFS = 11
ROD, REST = at_rest(chain(3), jnp.array([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]]))
SMALL = 1e-3

many_steps = jax.jit(roll_frames, static_argnums=(2, 3))
marched = jax.jit(march_frames, static_argnums=(2, 3))
one_step = jax.jit(advance)


@pytree
class Springs(Term):
    """`1/2 sum_i k_i (q_i - rest_i)^2`, and nothing of a rod."""

    stiffness: jax.Array

    def contribution(self, rod: Rod, state: State, stage: Stage, cache: Any) -> Contribution:
        return Diagonal(self.stiffness, REST.q)


@pytree
class Dampers(Term):
    """`Phi = 1/2 sum_i c_i v_i^2`."""

    resistance: jax.Array

    def contribution(self, rod: Rod, state: State, stage: Stage, cache: Any) -> Contribution:
        return Diagonal(self.resistance / stage.length, stage.origin_from(state))


def springs(scheme, terms: tuple[Term, ...], h: float = 1.0) -> Scene:
    """Eleven degrees of freedom that know nothing of each other."""
    settings = NewtonSettings(jnp.array(1e-15), jnp.ones(N_DOFS))
    return Scene(ROD, terms, None, settings, jnp.array(h), scheme)


@jax.jit
def ten_steps(scene: Scene, state: State, report: RolloutStats) -> tuple[State, RolloutStats]:
    """Ten more steps of a run."""
    states, report = roll_frames(scene, state, 1, 10, report)
    return jax.tree.map(lambda leaf: leaf[-1], states), report


def displaced(velocity: jax.Array, acceleration: jax.Array, length: float) -> State:
    """All degrees of freedom a little off their rest, at some motion."""
    return replace(
        REST,
        q=REST.q + SMALL,
        velocity=SMALL * velocity,
        acceleration=SMALL * acceleration,
        history=replace(REST.history, lengths=jnp.array([length, 0.0, 0.0])),
    )


def after(scene: Scene, state: State) -> np.ndarray:
    """Displacements from rest after one step, relative to those before it."""
    new, info = one_step(scene, state)
    assert info.status == Status.OK
    return np.asarray(new.q - REST.q) / SMALL, np.asarray(new.velocity) / SMALL


# Amplification --------------------------------------------------------------------------------

FACTOR = {
    "euler": (euler, lambda z: 1 / (1 - z)),
    "trbdf2": (trbdf2, lambda z: (1 + (1 - 2 * D) * z) / (1 - D * z) ** 2),
}
every_scheme = pytest.mark.parametrize("name", FACTOR)


@every_scheme
@pytest.mark.parametrize("length", [0.0, 1.0], ids=["first step", "later"])
def test_relaxation_is_amplified_by_the_function_of_the_scheme(name, length):
    """y' = lambda y for eleven lambda h from -1e-3 to -1e6, to round-off; and L-stable."""
    scheme, factor = FACTOR[name]
    for z in (-np.logspace(-3, 6, N_DOFS), np.full(N_DOFS, -1e12)):
        terms = (Springs(jnp.asarray(-z)), Dampers(jnp.ones(N_DOFS)))
        state = displaced(jnp.asarray(z), jnp.asarray(z**2), length)
        found, _ = after(springs(scheme, terms), state)
        rounding = np.finfo(float).eps * np.abs(z)  # of f0, which is z times as large as y
        assert (np.abs(found - factor(z)) < 1e-12 + rounding).all()
        assert abs(factor(-1e12)) < 1e-11


@every_scheme
def test_oscillation_is_amplified_by_the_function_of_the_scheme(name):
    """y'' = -w^2 y, that is z = +-i w h: amplitude and phase to round-off."""
    scheme, factor = FACTOR[name]
    w = np.linspace(0.05, 5.0, N_DOFS)
    terms = (Springs(jnp.asarray(w**2)), Inertia(jnp.ones(N_DOFS)))
    state = displaced(jnp.zeros(N_DOFS), jnp.asarray(-(w**2)), 1.0)
    q, velocity = after(springs(scheme, terms), state)
    np.testing.assert_allclose(q - 1j * velocity / w, factor(1j * w), rtol=1e-9)
    assert (np.abs(factor(1j * w)) < 1).all()  # no energy is made


def test_the_first_step_needs_no_velocity():
    """A rod without inertia moves at once, whatever velocity it was given at rest."""
    terms = (Springs(jnp.ones(N_DOFS)), Dampers(jnp.ones(N_DOFS)))
    ends = [
        after(springs(trbdf2, terms), displaced(v * jnp.ones(N_DOFS), jnp.zeros(N_DOFS), 0.0))[0]
        for v in (0.0, -1.0)
    ]
    np.testing.assert_allclose(ends[0], ends[1], rtol=1e-12)


# The order of the robot's path ----------------------------------------------------------------


@pytest.fixture(scope="module")
def developed() -> tuple[Scene, State]:
    """The robot with Stokeslets and head drag, a second after the motor was switched on."""
    file = SceneFile.model_validate(
        {
            "robot": {"edge_length": 12e-3},
            "time": {"step": 5e-3, "end": 1.0, "inertia": False},
            "solver": {"tolerance": 1e-12},
        }
    )
    scene = build(file)
    state = scene.start
    report = new_stats()
    for _ in range(20):
        state, report = ten_steps(scene, state, report)
    report.raise_if_failed()
    return scene, state


@pytest.mark.parametrize(
    ("scheme", "steps", "expected", "tolerance"),
    [(euler, (30, 60, 120), 1.0, 0.1), (trbdf2, (10, 20, 40), 2.0, 0.15)],
    ids=["euler", "trbdf2"],
)
def test_order_of_the_positions_of_nodes(developed, scheme, steps, expected, tolerance):
    """Against the second-order scheme in steps a quarter of the shortest or less."""
    scene, start = developed
    duration = 0.4

    def ends(scheme, n):
        shorter = replace(scene, scheme=scheme, step_length=jnp.array(duration / n))
        state, report = start, None
        for _ in range(n // 10):  # one program for every n
            state, report = ten_steps(shorter, state, report or new_stats())
        report.raise_if_failed()
        return np.asarray(positions(scene.rod.topology, state.q))

    exact = ends(trbdf2, 320)
    lengths = [duration / n for n in steps]
    errors = [np.sqrt(np.mean((ends(scheme, n) - exact) ** 2)) for n in steps]
    assert order(lengths, errors) == pytest.approx(expected, abs=tolerance)


def test_a_matrix_serves_several_iterations(developed):
    _, report = ten_steps(*developed, new_stats())
    assert int(report.factorings) < 0.6 * int(report.iterations)


# Adaptive steps -------------------------------------------------------------------------------

RATES = jnp.linspace(0.5, 20.0, N_DOFS)


def relaxing(
    tolerance: float | jax.Array, scheme=trbdf2, shortest: float = 0.0, h: float = 0.01
) -> tuple[Scene, State]:
    """y' = -rate y from 1, in units of the size that errors are measured in."""
    scene = springs(scheme, (Springs(RATES), Dampers(jnp.ones(N_DOFS))), h)
    control = StepSizeController(
        tolerance=jnp.asarray(tolerance),
        scale=jnp.full(N_DOFS, SMALL),
        shortest=jnp.asarray(shortest),
        order=1 if scheme is euler else 2,
    )
    still = jnp.zeros(N_DOFS)
    return replace(scene, control=control), displaced(still, still, 0.0)


def run(scene: Scene, state: State) -> tuple[np.ndarray, RolloutStats, np.ndarray]:
    """Displacements and times at frames of 0.5 s, and the report."""
    steps = round(0.5 / float(scene.step_length))
    states, report = many_steps(scene, state, 4, steps, new_stats())
    return np.asarray(states.q - REST.q) / SMALL, report, np.asarray(states.time)


@every_scheme
def test_errors_follow_the_tolerance(name):
    scheme, _ = FACTOR[name]
    errors, steps = [], []
    for tolerance in (1e-3, 1e-4, 1e-5):
        y, report, time = run(*relaxing(tolerance, scheme))
        report.raise_if_failed()
        np.testing.assert_allclose(time, [0.5, 1.0, 1.5, 2.0], rtol=1e-12)
        errors.append(np.abs(y - np.exp(-np.outer(time, RATES))).max())
        steps.append(int(report.steps))
    assert errors[0] < 20e-3
    wanted = 1 / 2 if scheme is euler else 2 / 3  # the error of a step is h^(order + 1)
    assert order([1e-3, 1e-4, 1e-5], errors) == pytest.approx(wanted, abs=0.2)
    assert steps[0] < steps[1] < steps[2]


def test_steps_grow_where_little_happens():
    """The last of four frames takes fewer steps than the first, and then only one."""
    scene, state = relaxing(1e-4)
    counts, report = [], new_stats()
    for _ in range(8):
        states, report = many_steps(scene, state, 4, 50, report)
        state = jax.tree.map(lambda leaf: leaf[-1], states)
        counts.append(int(report.steps))
    assert counts[1] - counts[0] < 0.5 * counts[0]
    assert counts[-1] - counts[-2] == 4


def test_a_first_step_that_is_too_long_is_given_up():
    y, report, time = run(*relaxing(1e-4, h=0.5))
    report.raise_if_failed()
    assert int(report.rejected) >= 1
    assert np.abs(y - np.exp(-np.outer(time, RATES))).max() < 4e-3


def test_a_run_continues_another_bit_by_bit():
    """The length that the next step would have had goes along in the report."""
    scene, start = relaxing(1e-4)
    whole, report = many_steps(scene, start, 4, 10, new_stats())
    state, full = start, new_stats()
    for _ in range(4):
        state, full = ten_steps(scene, state, full)
    np.testing.assert_array_equal(state.q, whole.q[-1])
    assert int(full.steps) == int(report.steps)


def test_steps_that_would_be_too_short_are_a_failure():
    scene, state = relaxing(1e-12, shortest=1e-3)
    y, report, _ = run(scene, state)
    assert Status(int(report.status)) is Status.TOO_SHORT
    assert np.isfinite(y).all()
    with pytest.raises(SolverError, match=r"t = 0 s.*Try"):
        report.raise_if_failed()


def test_more_steps_than_there_may_be_are_a_failure():
    scene, state = relaxing(1e-12)
    _, report, _ = run(scene, state)
    assert Status(int(report.status)) is Status.TOO_MANY
    assert 0 < float(report.failed_at) < 0.5
    with pytest.raises(SolverError, match="Try"):
        report.raise_if_failed()


@partial(jax.jit, static_argnums=2)
def last(stiffness: jax.Array, tolerance: jax.Array, n_frames: int) -> jax.Array:
    """The end of a run, for derivatives with respect to the stiffness of all springs."""
    scene, state = relaxing(tolerance)
    scene = replace(scene, terms=(Springs(stiffness * RATES), *scene.terms[1:]))
    states, _ = roll_frames(scene, state, n_frames, 50)
    return (states.q[-1] - REST.q) / SMALL


def test_derivatives_of_a_run_with_adaptive_steps():
    """Forward and reverse agree, and are those of the exact solution within its accuracy."""
    at, tolerance = jnp.array(1.0), jnp.array(1e-5)
    _, forward = jax.jvp(lambda k: last(k, tolerance, 1), (at,), (jnp.ones(()),))
    exact = -0.5 * RATES * jnp.exp(-0.5 * RATES)
    np.testing.assert_allclose(forward, exact, atol=2e-3)
    weights = jnp.cos(jnp.arange(N_DOFS))
    reverse = jax.grad(lambda k: weights @ last(k, tolerance, 1))(at)
    assert float(reverse) == pytest.approx(float(weights @ forward), rel=1e-12)


def test_derivatives_hold_the_sequence_of_steps():
    """Where lengths do not depend on the motion they are those of finite differences."""
    at, loose = jnp.array(1.0), jnp.array(1e9)
    _, forward = jax.jvp(lambda k: last(k, loose, 1), (at,), (jnp.ones(()),))
    difference = (last(at + 1e-5, loose, 1) - last(at - 1e-5, loose, 1)) / 2e-5
    np.testing.assert_allclose(forward, difference, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("rpm", [60.0, 0.3])
def test_what_is_left_unsolved_is_nothing_beside_the_error_of_a_step(rpm):
    """As much at the lowest rates, where the fluid's forces are small beside elastic ones."""
    file = SceneFile.model_validate(
        {
            "robot": {"edge_length": 15e-3},
            "fluid": {"hydrodynamics": "rft"},
            "motor": {"rpm": rpm},
            "time": {"step": 3.0 / rpm, "tolerance": 2e-3, "end": 180.0 / rpm},
        }
    )
    scene = build(file)
    assert scene.control is not None
    exactly = replace(scene, control=replace(scene.control, negligible=jnp.zeros(())))
    (states, report), (exact, as_it_was) = (
        marched(s, scene.start, 3, 20) for s in (scene, exactly)
    )
    report.raise_if_failed()
    assert report.steps == as_it_was.steps
    assert report.iterations < 0.7 * as_it_was.iterations
    off = np.abs(states.q - exact.q) / (scene.control.scale * scene.control.tolerance)
    assert 0.0 < off.max() < 1e-3 * report.steps


@pytest.mark.slow
@pytest.mark.parametrize("edge", [10e-3, 2.5e-3])
def test_default_steps_are_accurate_on_coarse_and_fine_meshes(edge):
    """The finer the mesh, the more violent the moment in which the flagellum goes limp."""
    file = SceneFile.model_validate({"robot": {"edge_length": edge}, "time": {"end": 3.0}})
    scene = build(file)
    state = scene.start

    def head_angle(scene: Scene) -> float:
        states, report = marched(scene, state, 3, 20)
        report.raise_if_failed()
        angle = kinematics.head_angle(scene.rod.topology, states)
        return float(angle[-1] - angle[0])

    finer = replace(scene.control, tolerance=jnp.asarray(1e-4))
    exact = head_angle(replace(scene, control=finer))
    assert head_angle(scene) == pytest.approx(exact, rel=5e-3)
