"""Free parameters: inverse of each other, always in range, derivative right."""

import jax.numpy as jnp
import numpy as np
import pytest

from derjax import InputError, SceneFile
from fitting.transforms import Interval, Log, Parameters, select_parameters


@pytest.mark.parametrize(
    ("transform", "values"),
    [(Log(), [1e-6, 0.3, 4.8, 1e7]), (Interval(-1.0, 0.5), [-0.999, 0.0, 0.3, 0.499])],
)
def test_value_undoes_free(transform, values) -> None:
    for value in values:
        assert float(transform.value(transform.free(value))) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize(("transform", "low", "high"), [(Log(), 0, np.inf), (Interval(2, 3), 2, 3)])
def test_every_free_number_is_in_range(transform, low, high) -> None:
    values = np.asarray(transform.value(jnp.linspace(-30.0, 30.0, 25)))
    assert (values > low).all() if high == np.inf else (values >= low).all()
    assert (values <= high).all()
    assert (np.diff(values) >= 0).all()


def test_slopes_are_derivatives() -> None:
    parameters = Parameters(("a", "b"), (Log(), Interval(0.0, 2.0)))
    free, h = np.array([0.7, -0.4]), 1e-6
    for i in range(2):
        ends = [parameters.values(jnp.asarray(free + s * h * np.eye(2)[i])) for s in (1, -1)]
        name = parameters.names[i]
        slope = float(ends[0][name] - ends[1][name]) / (2 * h)
        assert parameters.slopes(free)[i] == pytest.approx(slope, rel=1e-8)


@pytest.mark.parametrize(
    ("names", "says"),
    [
        ((), "no parameters"),
        (("C_t", "C_q"), "no parameter 'C_q'; the scene has .*C_t"),
        (("rpm",), "motor_rpm"),
        (("C_t", "C_t"), "twice"),
    ],
)
def test_wrong_names(names, says) -> None:
    with pytest.raises(InputError, match=says):
        select_parameters(names, SceneFile().parameters)


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [("C_t", 0.0, "C_t = 0: must be positive"), ("poisson_ratio", 0.5, "between -1 and 0.5")],
)
def test_start_out_of_range(name, value, says) -> None:
    with pytest.raises(InputError, match=says):
        select_parameters((name,), SceneFile().parameters).free({name: value})
