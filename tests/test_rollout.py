"""Rollouts: what they return, how they fail, and what their derivatives cost in memory."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import derjax
from derjax.core.pytree import replace
from derjax.integrate.frames import new_stats
from derjax.integrate.schemes.euler import euler
from derjax.scenes.file import SceneFile
from derjax.solve.newton import NewtonSettings
from derjax.terms import Gravity, ResistiveDrag, Stretch

_rollout = jax.jit(derjax.roll_frames, static_argnums=(2, 3))


def falling_rod(pull: jax.Array | float = 1.0) -> tuple[derjax.Scene, derjax.State]:
    """Three nodes on elastic edges, pulled through resistive drag; the smallest moving scene."""
    topology = derjax.chain(3, filaments=((0, 1, 2),))
    rod, state = derjax.at_rest(topology, jnp.array([[0.0, 0, 0], [0.01, 0, 0], [0.02, 0.001, 0]]))
    terms = (
        Stretch(jnp.full(2, 1.0)),
        ResistiveDrag(jnp.array(5.0), jnp.array(10.0)),
        Gravity(jnp.array([1e-3, 2e-3, 4e-3]) * pull, jnp.array([0.5, 0.0, -1.0])),
    )
    # Nothing resists the angles of this rod: hold them.
    rod = replace(rod, topology=replace(topology, fixed_dofs=(9, 10)))
    settings = NewtonSettings(jnp.array(1e-10), jnp.full(topology.n_dofs, 1e-3))
    return derjax.Scene(rod, terms, None, settings, jnp.array(0.01), euler), state


def test_frames_do_not_depend_on_how_steps_are_grouped():
    scene, start = falling_rod()
    every, _ = _rollout(scene, start, 24, 1)
    some, report = _rollout(scene, start, 4, 6)
    np.testing.assert_array_equal(some.q, every.q[5::6])
    assert int(report.steps) == 24
    assert float(some.time[-1]) == pytest.approx(0.24)


def test_a_rollout_continues_another():
    scene, start = falling_rod()
    whole, report = _rollout(scene, start, 4, 6)
    first, half = _rollout(scene, start, 2, 6)
    middle = jax.tree.map(lambda leaf: leaf[-1], first)
    second, full = _rollout(scene, middle, 2, 6, half)
    np.testing.assert_array_equal(second.q[-1], whole.q[-1])
    assert int(full.steps) == int(report.steps)
    assert int(full.iterations) == int(report.iterations)


ROBOTS = {
    "one": {},
    "two": {"robot": {"kind": "two_flagella"}},
    "limited torque": {"motor": {"stall_torque": 3e-4, "free_rpm": 100.0}},
    "second order": {"time": {"scheme": "trbdf2"}},
}


@pytest.mark.parametrize("name", ROBOTS)
def test_a_run_goes_on_in_the_program_that_it_began_in(name):
    """What comes out has the types of what goes in, weak ones included."""
    scene = derjax.build(SceneFile.model_validate(ROBOTS[name]))
    given = scene.start, new_stats()

    def gone_on():
        states, report = derjax.march_frames(scene, given[0], 1, 1, given[1])
        return jax.tree.map(lambda leaf: leaf[0], states), report

    kinds = [
        [(x.shape, x.dtype, x.weak_type) for x in jax.tree.leaves(jax.eval_shape(f))]
        for f in (lambda: given, gone_on)
    ]
    assert kinds[0] == kinds[1]


def test_a_step_is_traced_once_for_all_programs():
    """And for all loops and derivatives that take it: tracing is what compiling costs first."""
    traced = []

    def counted(scene, state, length):
        traced.append(length)
        return euler(scene, state, length)

    scene, start = falling_rod()
    scene = replace(scene, scheme=counted)
    for program in (derjax.march_frames, derjax.roll_frames):

        def end(pull, program=program):
            gravity = replace(scene.terms[-1], acceleration=pull * scene.terms[-1].acceleration)
            pulled = replace(scene, terms=(*scene.terms[:-1], gravity))
            return program(pulled, start, 2, 3)[0].q[-1]

        jax.jit(end).trace(1.0)
        jax.jit(jax.jacfwd(end)).trace(1.0)
    assert len(traced) == 1


@pytest.mark.slow
def test_first_order_in_time():
    scene, start = falling_rod()
    ends = []
    for n in (20, 40, 80, 160):
        states, _ = _rollout(replace(scene, step_length=jnp.array(0.4 / n)), start, 1, n)
        ends.append(np.asarray(states.q[-1]))
    gaps = [np.abs(a - b).max() for a, b in itertools.pairwise(ends)]
    orders = np.log2(np.array(gaps[:-1]) / np.array(gaps[1:]))
    np.testing.assert_allclose(orders[-1], 1.0, atol=0.1)


@pytest.mark.slow
def test_memory_of_reverse_mode_grows_like_the_square_root_of_steps():
    def loss(pull, n):
        scene, start = falling_rod(pull)
        states, _ = derjax.roll_frames(scene, start, 1, n)
        return jnp.sum(states.q[-1])

    def temporary(n):
        compiled = jax.jit(jax.grad(loss), static_argnums=1).lower(1.0, n).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    few, many = 400, 40_000
    exponent = np.log(temporary(many) / temporary(few)) / np.log(many / few)
    assert exponent < 0.55


SWIMMER = SceneFile.model_validate(
    {
        "robot": {"edge_length": 0.03},
        "fluid": {"hydrodynamics": "rft"},
        "motor": {"rpm": 600.0},
        "time": {"step": 0.01, "scheme": "euler"},
        "solver": {"max_iterations": 2},
    }
)


def test_a_failed_step_is_told_and_freezes_the_run():
    scene = derjax.build(SWIMMER)
    start = scene.start
    states, report = _rollout(scene, start, 8, 1)
    assert not report.ok
    assert derjax.Status(int(report.status)) is derjax.Status.MAX_ITERATIONS
    done = int(report.steps)
    assert done < 8
    assert float(report.failed_at) == pytest.approx(0.01 * done)
    for k in range(done, 8):
        np.testing.assert_array_equal(states.q[k], states.q[max(done - 1, 0)] if done else start.q)
    assert np.isfinite(states.q).all()
    with pytest.raises(derjax.SolverError, match=r"t = .* s failed.*residual.*Try"):
        report.raise_if_failed()


def test_non_finite_numbers_are_told():
    scene = derjax.build(SWIMMER)
    start = scene.start
    broken = replace(start, q=start.q.at[5].set(jnp.nan))
    states, report = _rollout(scene, broken, 8, 1)
    assert derjax.Status(int(report.status)) is derjax.Status.NON_FINITE
    assert int(report.steps) == 0
    del states


def test_a_rollout_does_not_touch_what_has_failed():
    scene = derjax.build(SWIMMER)
    start = scene.start
    failed = replace(new_stats(), status=jnp.array(2, jnp.int32), failed_at=jnp.array(1.0))
    states, report = _rollout(scene, start, 8, 1, failed)
    np.testing.assert_array_equal(states.q[-1], start.q)
    assert float(report.failed_at) == 1.0
