"""Gradient descent: lower losses, the best kept, failures survived."""

import jax.numpy as jnp
import numpy as np
import pytest

from derjax import SolverError
from fitting.descent import descend, track_loss
from fitting.observe import interpolation
from fitting.simulate import motor_rate


def bowl(free):
    return jnp.sum((free - jnp.array([1.0, -0.5])) ** 2), jnp.zeros((), jnp.int32)


def test_the_minimum_of_a_bowl_is_found() -> None:
    found = descend(bowl, np.zeros(2), steps=200, rate=0.1)
    assert found.free == pytest.approx([1.0, -0.5], abs=1e-2)
    assert found.status == "finished"
    assert found.loss == min(found.losses)
    assert len(found.losses) == 200


def test_the_best_is_kept_though_the_search_goes_on() -> None:
    found = descend(bowl, np.array([1.0, -0.49]), steps=6, rate=1.0)
    assert found.losses[1] > found.losses[0]
    assert found.loss == min(found.losses)
    assert float(bowl(found.free)[0]) == pytest.approx(found.loss)


def test_failures_lead_back_to_the_best() -> None:
    def cliff(free):
        loss = jnp.where(free[0] > 0.3, jnp.nan, bowl(free)[0])
        return loss, (free[0] > 0.3).astype(jnp.int32)

    found = descend(cliff, np.zeros(2), steps=40, rate=0.2)
    assert np.isnan(found.losses).any()
    assert found.free[0] <= 0.3
    assert found.loss < 0.8 * found.losses[0]
    with pytest.raises(SolverError, match="start"):
        descend(cliff, np.ones(2), steps=3)


def test_an_interruption_keeps_the_best() -> None:
    def interrupt(step, loss, free) -> None:
        if step == 3:
            raise KeyboardInterrupt

    found = descend(bowl, np.zeros(2), steps=50, on_step=interrupt)
    assert found.status == "interrupted"
    assert len(found.losses) == 4


@pytest.mark.slow
def test_many_parameters_descend_on_tracks(dataset, simulator) -> None:
    run = dataset.runs[1]
    objective = track_loss(dataset, simulator.parameters, [run])
    found = descend(objective, np.zeros(2), steps=12, rate=0.3)
    assert found.loss < 0.3 * found.losses[0]

    at_frames = interpolation(run.time, dataset.scene.step)
    seen = simulator.run(np.zeros(2), motor_rate(dataset.scene, run), at_frames.n_steps)
    error = at_frames(seen.observed) - run.values
    scale = np.where(run.is_angle, np.ptp(run.values[:, 3]), np.ptp(run.values[:, 0]))
    assert found.losses[0] == pytest.approx(np.mean((error / scale) ** 2), rel=1e-9)
