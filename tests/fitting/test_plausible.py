"""Parameters that run away, and values that no robot has."""

from dataclasses import replace

import numpy as np
import pytest

from fitting.conclusion import Conclusion, judge
from fitting.levenberg import Optimum
from fitting.model import Model
from fitting.plausible import course, implausible, runaway
from fitting.transforms import select_parameters
from fitting.uncertainty import Residuals

NAMES = ("C_t", "youngs_modulus", "poisson_ratio")
START = {"C_t": 2.0, "youngs_modulus": 1e6, "poisson_ratio": 0.3}


def test_a_parameter_runs_away_where_the_tracks_do_not_feel_it() -> None:
    one = np.ones(20)
    columns = np.stack([1e-3 * one, 1e-3 * one, one], axis=1)
    residuals = Residuals(one, columns, np.zeros(20, int), one, 1e-9 * one)
    assert runaway(residuals, np.array([-4.0, 3.0, 9.0])).tolist() == [True, False, False]


def test_where_parameters_run() -> None:
    parameters = select_parameters(NAMES, START)
    assert course(parameters, 0, 4.0) == "grows without end"
    assert course(parameters, 0, -4.0) == "falls towards 0"
    assert course(parameters, 2, 4.0) == "grows towards 0.5"


def test_what_is_not_plausible() -> None:
    """A prefactor by its size, wherever it started; others by their way from the start."""
    parameters = select_parameters(NAMES, START)
    usual = {"C_t": 20.0, "youngs_modulus": 2e7, "poisson_ratio": 0.49}
    assert implausible(parameters, usual, {**START, "C_t": 0.2}) == {}
    odd = implausible(parameters, {**usual, "C_t": 3e4, "youngs_modulus": 1e3}, START)
    assert list(odd) == ["C_t", "youngs_modulus"]
    assert odd["C_t"].startswith("C_t = 3e+04 would be the drag of a head far larger than a ball")
    assert odd["youngs_modulus"] == "youngs_modulus = 1000 is far from its start, 1e+06"


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "remark"), [(1e5, "is not plausible"), (3.0, "hardly decide")])
def test_another_optimum_is_said_to_be_absurd(dataset, simulator, factor, remark) -> None:
    model = Model(dataset, simulator.parameters)
    free = simulator.parameters.free({"C_t": 4.8, "C_r": 0.36})
    trial = model.preview(free)
    assert trial is not None
    best = Optimum(free, trial, "converged", ())
    other = replace(best, free=free + np.log([1.0, factor]))
    start = {"C_t": 4.0, "C_r": 0.4}
    end = Conclusion(model, start, None, (best, other), judge(model, best), ())
    fit = end.fit(None, 0, 1, 0.0)
    (said,) = [warning for warning in fit.warnings if "fits nearly as well" in warning]
    assert remark in said
    assert ("C_r" in fit.alternatives[0].implausible) == (factor > 30)
