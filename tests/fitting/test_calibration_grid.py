"""A part of `benchmarks.calibration`: the truth is found whatever was tracked, or it is said."""

import numpy as np
import pytest

from benchmarks.calibration import TRUTH, Case, fitted, scene_of, track

pytestmark = pytest.mark.slow

CASES = (
    Case("one", "all", 0.2, (5.0, 0.2), 1),
    Case("one", "angle", 1.0, (5.0, 0.2), 2),
    Case("one", "x", 1.0, (5.0, 5.0), 1),
    Case("one", "x, y, z", 1.0, (5.0, 5.0), 1),
)


def name_of(case: Case) -> str:
    return f"{case.channels} from {case.start}"


@pytest.fixture(scope="module")
def seen() -> np.ndarray:
    return track(scene_of("one"), 61.0)


@pytest.mark.parametrize("case", CASES, ids=name_of)
def test_the_truth_lies_within_three_standard_errors(case: Case, seen: np.ndarray) -> None:
    fit = fitted(case, scene_of(case.flagella), seen)
    assert fit.status == "converged"
    assert fit.goodness.good
    for name, estimate in fit.estimates.items():
        assert abs(estimate.value - TRUTH[name]) <= 3.0 * estimate.std
        if np.isinf(estimate.std):
            assert any(warning.startswith(name) for warning in fit.warnings)
    settled = {name for name, e in fit.estimates.items() if np.isfinite(e.std)}
    assert {"all": {"C_t", "C_r"}, "angle": {"C_r"}}.get(case.channels, {"C_t"}) <= settled
