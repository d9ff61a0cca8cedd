"""Where the flagellum buckles; `benchmarks.buckling` has the figures."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.buckling import (
    Bracket,
    Length,
    bracket,
    is_buckled,
    measure,
    omega_bar,
    refined,
    robot,
    simulate,
)
from derjax.core.pytree import replace
from derjax.core.status import Status
from derjax.integrate.frames import new_stats

NAN = math.nan


def test_the_rate_is_that_of_the_paper():
    assert omega_bar(robot(5), 60.0) == pytest.approx(80.6, abs=0.05)


@pytest.mark.parametrize(
    ("means", "expected"),
    [
        ([1.01, 1.02, 0.90, 0.50], Bracket(2.0, 3.0)),
        ([1.01, 1.02, 1.03, 1.02], Bracket(4.0, None)),
        ([0.90, 0.80, 0.70, 0.60], Bracket(None, 1.0)),
        ([1.01, 0.90, 1.01, 0.60], Bracket(1.0, 2.0)),  # the slowest that buckles
        ([1.01, NAN, 0.90, 0.60], Bracket(1.0, 3.0)),  # a failed run says nothing
        ([NAN, NAN, NAN, NAN], Bracket(None, None)),
    ],
)
def test_bracket(means, expected):
    assert bracket(zip([1.0, 2.0, 3.0, 4.0], means, strict=True)) == expected


def test_a_bracket_is_halved_as_often_as_asked():
    points = refined(lambda rate: 1.02 if rate < 3.3 else 0.8, [1.0, 2.0, 3.0, 4.0], halvings=3)
    assert len(points) == 7
    assert bracket(points) == Bracket(3.25, 3.375)
    assert len(refined(lambda rate: 1.02, [1.0, 2.0], halvings=3)) == 2


def test_the_window_leaves_out_the_start():
    time = np.linspace(0.0, 60.0, 601)
    found = measure(Length(time, np.where(time < 40.0, 5.0, 0.9), new_stats()))
    assert found.min == found.max == 0.9
    assert found.mean == pytest.approx(0.9)
    assert found.status == "ok"


def test_a_failed_run_has_a_message_and_no_numbers():
    failed = replace(new_stats(), status=jnp.array(int(Status.LINE_SEARCH)))
    found = measure(Length(np.zeros(1), np.ones(1), failed))
    assert math.isnan(found.mean)
    assert "line search" in found.status
    assert is_buckled(found.mean) is None


@pytest.mark.slow
def test_buckles_at_pitch_5_between_the_rates_of_an_independent_code():
    file = robot(5)
    slow, fast = (measure(simulate(file, rpm)) for rpm in (150.0, 200.0))
    assert omega_bar(file, 150.0) == pytest.approx(201, abs=1)
    assert omega_bar(file, 200.0) == pytest.approx(269, abs=1)
    assert is_buckled(slow.mean) is False
    assert is_buckled(fast.mean) is True
