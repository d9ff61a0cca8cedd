"""The tour through the Python interface in docs/examples runs as it stands."""

import runpy
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

TOUR = Path(__file__).parents[1] / "docs" / "examples" / "tour.py"


def test_the_tour(tmp_path, capsys):
    runpy.run_path(str(TOUR))["main"](tmp_path)
    said = capsys.readouterr().out
    assert "10. What cannot be says so" in said
    assert "no parameter 'pich'" in said
    assert {p.name for p in tmp_path.iterdir()} == {"shape.png", "swim.gif"}
