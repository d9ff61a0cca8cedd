"""The tests stay quick: what each file was measured to cost is within its budget.

What is compared are stored times, so that no test fails because a computer is busy. After a
change that makes a file slower or quicker, or for a new file, measure it again, one file or
all of them, with nothing else running:

    pytest --store-durations tests/test_blocks.py
"""

import json

import pytest
from quick import DURATIONS, files_with_tests

BUDGET = 70.0
"""Seconds of processor time for one file, with nothing compiled."""

LARGER: dict[str, tuple[float, str]] = {
    "test_steady.py": (150.0, "derivatives of eigenvalues are second derivatives of all forces"),
    "test_blocks.py": (130.0, "four kinds of robot, by two solvers that share no program"),
    "test_orbit.py": (110.0, "derivatives of turns, of one and of two flagella"),
    "test_equilibrium.py": (85.0, "rods under four kinds of load, each a program of its own"),
    "test_torque_motor.py": (110.0, "every kind of motor and robot is a program of its own"),
    "test_readme.py": (110.0, "the calibration that README promises, on its own mesh"),
    "fitting/test_joint.py": (130.0, "two robots and every kind of nuisance, each a program"),
    "fitting/test_orbit_gaits.py": (80.0, "derivatives of orbits, and a posterior over them"),
    "fitting/test_design.py": (240.0, "derivatives of steady states, runs and eigenvalues"),
    "test_notebooks.py": (
        300.0,
        "six notebooks, each in a process of its own and compiling its own",
    ),
}
"""Files that may take longer, how long, and why."""

ALL = 3050.0
"""Seconds for all files together. It is what they take on two processors that share their caches,
not what they should: with 1000 s the tests would take ten minutes."""

STORED: dict[str, float] = json.loads(DURATIONS.read_text())
FILES = [
    path.relative_to(DURATIONS.parent).as_posix()
    for path in files_with_tests()
    if path.name != "test_budget.py"
]


@pytest.mark.parametrize("file", FILES)
def test_a_file_is_within_its_budget(file):
    assert file in STORED, f"not measured: pytest --store-durations tests/{file}"
    budget, _ = LARGER.get(file, (BUDGET, ""))
    assert STORED[file] <= budget


def test_all_files_together_are():
    assert sum(STORED.values()) <= ALL


def test_larger_budgets_are_of_files_that_need_them():
    for file, (budget, reason) in LARGER.items():
        assert file in FILES
        assert reason
        assert STORED[file] > BUDGET
        assert budget > BUDGET
