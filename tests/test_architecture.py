"""How the code is put together: who may import whom, and what compiled code must not contain."""

import ast
import builtins
import dis
import importlib
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import CodeType

import pytest

ROOT = Path(__file__).parents[1]
DERJAX = ROOT / "derjax"
MODULES = sorted(DERJAX.rglob("*.py"))
SOURCES = sorted(
    path for name in ("derjax", "fitting", "benchmarks") for path in (ROOT / name).rglob("*.py")
)

FLOORS = (
    ("core",),
    ("io",),
    ("rods",),
    ("shapes", "solve"),
    ("terms",),
    ("integrate",),
    ("steady",),
    ("scenes",),
    ("results",),
    ("runs",),
    ("commands",),
)
"""The folders of derjax from the ground up: what it is, how it is solved, what acts, how time goes,
how it is described, what comes out, who runs it."""

RANKS = {folder: rank for rank, folders in enumerate(FLOORS) for folder in folders}

ENTRANCES = {"__init__", "__main__", "robots"}
"""Modules that stand in no folder."""

CALLBACKS = ("debug", "debug_callback", "pure_callback", "io_callback", "error_if", "host_callback")
"""Calls of the host from compiled code, which keep it out of the persistent cache."""


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), name_of(path))


def imports(path: Path) -> Iterator[str]:
    """Full dotted names of all that a module imports, relative imports resolved.

    `from a.b import c` gives `a.b.c`, which covers `c` being a module.
    """
    package = path.relative_to(ROOT).with_suffix("").parts[:-1]
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            stem = ".".join([*base, *([node.module] if node.module else [])])
            yield from (f"{stem}.{alias.name}" for alias in node.names)


def folder_of(path: Path) -> str | None:
    """The folder of derjax in which a module stands; None for the entrances."""
    parts = path.relative_to(DERJAX).parts
    return parts[0] if len(parts) > 1 else None


def folders(path: Path) -> set[str]:
    """The folders of derjax from which a module imports, or modules that stand in none."""
    parts = [name.split(".") for name in imports(path)]
    return {p[1] for p in parts if p[0] == "derjax" and len(p) > 1}


def test_relative_imports_are_resolved():
    """The tests below would pass for want of names if the resolution were wrong."""
    bend = set(imports(DERJAX / "terms" / "elastic" / "bend.py"))
    assert {"derjax.solve.contributions.Elements", "derjax.terms.term.Stage"} <= bend
    assert {"integrate", "io", "rods", "terms"} <= folders(
        DERJAX / "scenes" / "ingredients" / "time.py"
    )


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_modules_import_only_from_floors_below_their_own(path):
    folder = folder_of(path)
    if folder is None:
        assert path.stem in ENTRANCES, "a module that stands in no folder"
        return
    assert folder in RANKS, "a folder without a floor"
    above = {other for other in folders(path) if other != folder} - {"__version__"}
    wrong = {other for other in above if RANKS.get(other, len(FLOORS)) >= RANKS[folder]}
    assert not wrong, f"{name_of(path)} imports from {', '.join(sorted(wrong))}"


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_derjax_does_not_know_fitting(path):
    assert not [name for name in imports(path) if name.split(".")[0] == "fitting"]


def test_modules_of_derjax_do_not_import_each_other_in_a_circle():
    def module(name: str) -> Path | None:
        parts = name.split(".")
        if parts[0] != "derjax":
            return None
        for size in range(len(parts), 1, -1):  # the longest part of the name that is a file
            path = ROOT.joinpath(*parts[:size]).with_suffix(".py")
            if path.exists():
                return path
        return None

    known = {
        path: {m for m in map(module, imports(path)) if m not in (None, path)} for path in MODULES
    }
    while known:
        free = [path for path, needs in known.items() if not needs & known.keys()]
        assert free, f"a circle among {', '.join(sorted(name_of(path) for path in known))}"
        for path in free:
            del known[path]


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_compiled_code_does_not_call_the_host(path):
    used = {node.attr for node in ast.walk(tree_of(path)) if isinstance(node, ast.Attribute)}
    used |= {part for name in imports(path) for part in name.split(".")}
    assert not used & set(CALLBACKS)


TERM_CLASSES = sorted(
    (node.name, path)
    for path in (DERJAX / "terms").rglob("*.py")
    for node in tree_of(path).body
    if isinstance(node, ast.ClassDef)
    and any(isinstance(base, ast.Name) and base.id == "Term" for base in node.bases)
)


@pytest.mark.parametrize(("name", "path"), TERM_CLASSES, ids=[name for name, _ in TERM_CLASSES])
def test_every_term_has_a_file_and_is_made_by_a_table(name, path):
    """A table of scene files makes every term that they may ask for."""
    assert ast.get_docstring(tree_of(path)), "the module has no docstring"
    assert [n for n, other in TERM_CLASSES if other == path] == [name], "several in one file"
    if name == "Energy":  # for Python: a file cannot hold a function
        return
    tables = (DERJAX / "scenes" / "ingredients").glob("*.py")
    calls = {
        node.func.id
        for table in tables
        for node in ast.walk(tree_of(table))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    assert name in calls


def globals_used(code: CodeType) -> Iterator[str]:
    """Names that a function, or one within it, looks up in its module."""
    for step in dis.get_instructions(code):
        if step.opname == "LOAD_GLOBAL":
            yield step.argval
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from globals_used(inner)


@pytest.mark.parametrize("path", SOURCES, ids=name_of)
def test_names_are_defined(path):
    """Checkers of style do not ask: they take shapes in annotations for names."""
    code = compile(path.read_text(encoding="utf-8"), name_of(path), "exec")
    used = {
        name
        for inner in code.co_consts
        if isinstance(inner, CodeType)
        for name in globals_used(inner)
    }
    if path.stem == "__main__":
        known = set(code.co_names)
    else:
        parts = path.relative_to(ROOT).with_suffix("").parts
        module = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        known = set(vars(importlib.import_module(module)))
    assert not used - known - set(dir(builtins))


def test_the_version_is_the_same_everywhere():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    cited = re.search(r'^version: "?([^"\n]+)"?$', citation, re.MULTILINE)
    changed = re.search(r"^## \[?(\d+\.\d+\.\d+[^\]\s]*)\]?", changes, re.MULTILINE)
    assert cited
    assert changed
    assert cited[1] == changed[1] == project["version"]


PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *ROOT.glob("*/README.md")])
NAMED = re.compile(r"`((?:derjax|fitting|benchmarks|tests|docs|data|notebooks)/[\w./]*\w)`")


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_files_that_pages_name_are_there(page):
    named = NAMED.findall(page.read_text(encoding="utf-8"))
    assert not [path for path in named if not (ROOT / path).exists()]
