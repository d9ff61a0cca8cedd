"""derjax against trajectories of an independent code; `benchmarks.cross_code` has the figures."""

import pytest

from benchmarks.cross_code import RATES, compare, scene, simulate


@pytest.fixture(scope="module")
def differences():
    """Over 5 to 10 s, with the drag matrix as that code solves with it: one triangle of it."""
    fluid = {"drag_matrix": "lower_triangle"}
    return {
        rpm: compare(rpm, simulate(scene(rpm, end=10.0, fluid=fluid)), since=5.0) for rpm in RATES
    }


@pytest.mark.parametrize("rpm", RATES)
def test_swims_and_turns_as_the_reference_does(differences, rpm):
    assert abs(differences[rpm]["v_x"]) < 0.001
    assert abs(differences[rpm]["head_rate"]) < 0.0015
    assert abs(differences[rpm]["head_to_tail"]) < 0.0005


def test_every_node_is_where_the_reference_has_it(differences):
    assert differences[70]["nodes"] < 0.015
