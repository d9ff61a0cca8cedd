"""The notebooks run, their executed copies have the same cells, and the gallery shows those."""

import os
import runpy
from pathlib import Path

import jupytext
import nbformat
import pytest
from nbclient import NotebookClient
from nbformat import NotebookNode
from quick import environment, environment_of_users

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.py"))
OPTIMISED = {"04_bundling_phases_friction"}
"""Those that run for longer than they take to compile well."""

TIMEOUT = 900
"""Seconds that a cell may take, on a computer that is busy with something else as well."""


def sources(notebook: NotebookNode) -> list[tuple[str, str]]:
    """Kind and text of every cell."""
    return [(cell.cell_type, cell.source.strip()) for cell in notebook.cells]


def test_there_are_notebooks():
    assert NOTEBOOKS


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_executed_copy_is_in_sync(path):
    executed = nbformat.read(path.with_suffix(".ipynb"), as_version=4)
    assert sources(executed) == sources(jupytext.read(path))
    code = [cell for cell in executed.cells if cell.cell_type == "code"]
    counts = [cell.execution_count for cell in code]
    assert counts == list(range(1, len(code) + 1)), "not executed from top to bottom"
    assert not [o for cell in code for o in cell.outputs if o.output_type == "error"]
    assert [o for cell in code for o in cell.outputs if "image/png" in o.get("data", {})]


def test_gallery_shows_every_notebook():
    """Its page and its pictures are those that `python docs/make_gallery.py` would make now."""
    gallery = runpy.run_path(str(ROOT / "docs" / "make_gallery.py"))
    notebooks = gallery["read"]()
    assert list(notebooks) == [path.stem for path in NOTEBOOKS]
    page = gallery["PAGE"].read_text(encoding="utf-8")
    assert page == gallery["page"](notebooks)
    pictures = {path.stem: path.read_bytes() for path in gallery["PICTURES"].glob("*.png")}
    assert pictures == {stem: gallery["picture"](one) for stem, one in notebooks.items()}
    for stem in notebooks:
        assert f"(../notebooks/{stem}.ipynb)" in page
        assert f"(gallery/{stem}.png)" in page
    assert "docs/gallery.md" in (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path, monkeypatch):
    """From top to bottom; each checks its own numbers with assertions."""
    chosen = environment_of_users if path.stem in OPTIMISED else environment
    monkeypatch.setattr(os, "environ", chosen())
    monkeypatch.delenv("MPLBACKEND", raising=False)
    notebook = jupytext.read(path)
    where = {"metadata": {"path": str(path.parent)}}
    NotebookClient(notebook, timeout=TIMEOUT, kernel_name="python3", resources=where).execute()
