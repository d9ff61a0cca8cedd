"""Forward sensitivities against reverse mode and against finite differences."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from derjax import build
from fitting.model import Model
from fitting.observe import seen
from fitting.simulate import Simulator, _continue, simulate, steps_per_call
from fitting.tracks import Dataset, Run

FREE = np.log([3.0, 0.5])
RPM = jnp.array(100.0)
STEPS = 50
"""More than one call of the compiled program, less than two."""


@pytest.fixture(scope="module")
def simulated(simulator):
    return simulator.run(FREE, RPM, STEPS)


def test_sensitivities_are_those_of_finite_differences(simulator, simulated) -> None:
    h = 1e-4
    for i, along in enumerate(np.eye(2)):
        ends = [simulator.run(FREE + s * h * along, RPM, STEPS).observed for s in (1, -1)]
        slope = (ends[0] - ends[1]) / (2 * h)
        scale = np.abs(slope).max(axis=0)
        error = np.abs(simulated.sensitivity[..., i] - slope) / scale
        assert error.max() < 1e-5


@pytest.mark.slow
def test_one_rollout_and_reverse_mode_agree_with_joined_calls(simulator, simulated) -> None:
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(STEPS + 1, 4)))

    def total(free):
        seen, report = simulate(simulator.scene, simulator.parameters, free, RPM, STEPS)
        return jnp.sum(weights * seen), (seen, report)

    gradient, (whole, report) = jax.jit(jax.grad(total, has_aux=True))(jnp.asarray(FREE))
    assert bool(report.ok)
    assert np.allclose(simulated.observed[: STEPS + 1], whole, rtol=0, atol=1e-10)
    assert simulated.time[STEPS] == pytest.approx(STEPS * simulator.scene.step)
    forward = np.tensordot(weights, simulated.sensitivity[: STEPS + 1], axes=2)
    assert np.asarray(gradient) == pytest.approx(forward, rel=1e-6)


def test_runs_of_other_lengths_and_rates_share_the_program(simulator, simulated) -> None:
    before = _continue.count
    short, long = simulator.runs(FREE, [jnp.array(70.0), RPM], [10, STEPS])
    assert _continue.count == before
    assert len(short.time) == simulator.steps_per_call + 1
    assert np.array_equal(long.observed, simulated.observed)
    assert np.abs(short.observed[20] - long.observed[20]).max() > 1e-3


@pytest.mark.parametrize("longest", [1, 199, 200, 201, 999, 4000, 4002])
def test_little_is_simulated_in_vain(longest) -> None:
    length = steps_per_call(longest)
    calls = -(-longest // length)
    assert length <= 200
    assert calls * length - longest < calls


@pytest.fixture(scope="module")
def silhouettes(simulator) -> Simulator:
    """The simulator for a camera that looks along z and follows the whole robot."""
    return Simulator(simulator.scene, simulator.parameters, 40, sight=2)


@pytest.mark.slow
def test_silhouettes_are_simulated_with_their_sensitivities(silhouettes) -> None:
    here = silhouettes.run(FREE, RPM, 40)
    built = build(silhouettes.scene, silhouettes.parameters.values(jnp.asarray(FREE)))
    first = seen(built, jax.tree.map(lambda x: x[None], built.start), 2)
    assert here.observed[0] == pytest.approx(np.asarray(first)[0], abs=1e-15)
    h = 1e-4
    ends = [silhouettes.run(FREE + s * h, RPM, 40).observed for s in (1, -1)]
    slope = (ends[0] - ends[1]) / (2 * h)
    error = np.abs(here.sensitivity.sum(axis=-1) - slope) / np.abs(slope).max(axis=0)
    assert error.max() < 1e-5


def test_silhouettes_are_not_continued_by_screws(silhouettes) -> None:
    """The robot rolls, and a camera that stays where it is sees another silhouette then."""
    times = np.linspace(0.0, 6.0, 20)
    run = Run("side", times, (0, 1), np.zeros((20, 2)), 60.0)
    for sight, period in ((None, 1.0), (2, None)):
        dataset = Dataset(silhouettes.scene, (replace(run, sight=sight),))
        assert Model(dataset, silhouettes.parameters).periods == [period]
