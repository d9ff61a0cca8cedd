"""The tests stay quick: what each file was measured to cost, without what is marked slow, is
within its budget.

What is compared are stored times, so that no test fails because a computer is busy. After a
change that makes a file slower or quicker, or for a new file, measure it again, one file or
all of them, with nothing else running:

    pytest --store-durations tests/test_blocks.py
"""

import json
import re

import pytest
from quick import DURATIONS, files_with_tests

BUDGET = 70.0
"""Seconds of processor time for one file, with nothing compiled."""

ALL = 1100.0
"""Seconds for all files together, as they take on two processors that share their caches: with the
installation, `.ci/run` then takes ten minutes."""

STORED: dict[str, float] = json.loads(DURATIONS.read_text())
WHOLLY_SLOW = re.compile(r"^pytestmark = .*\bmark\.slow\b", re.MULTILINE)
FILES = [
    path.relative_to(DURATIONS.parent).as_posix()
    for path in files_with_tests()
    if path.name != "test_budget.py" and not WHOLLY_SLOW.search(path.read_text(encoding="utf-8"))
]


@pytest.mark.parametrize("file", FILES)
def test_a_file_is_within_its_budget(file):
    assert file in STORED, f"not measured: pytest --store-durations tests/{file}"
    assert STORED[file] <= BUDGET


def test_all_files_together_are():
    assert sum(STORED[file] for file in FILES) <= ALL
