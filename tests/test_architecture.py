"""How the code is put together: who may import whom, and what compiled code must not contain."""

import ast
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DERJAX = ROOT / "derjax"
TERMS = DERJAX / "terms"
MODULES = sorted(DERJAX.rglob("*.py"))
TERM_MODULES = sorted(p for p in TERMS.glob("*.py") if p.stem not in ("__init__", "term"))

RIGHT_OF_TERMS = {
    "cli",
    "commands",
    "control",
    "fitting",
    "newton",
    "plots",
    "recording",
    "shapes",
    "frames",
    "scene",
    "scenefile",
    "schemes",
    "simulation",
    "step",
    "summary",
    "trajectory",
}
"""What is made of terms, and so must not be known to them."""

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


def layers(path: Path) -> set[str]:
    """The modules of derjax that a module imports, by the first name below `derjax`."""
    parts = [name.split(".") for name in imports(path)]
    return {p[1] for p in parts if p[0] == "derjax" and len(p) > 1}


def test_relative_imports_are_resolved():
    """The tests below would pass for want of names if the resolution were wrong."""
    assert "derjax.potential.Elements" in set(imports(TERMS / "bend.py"))
    assert "derjax.terms.term.Stage" in set(imports(TERMS / "bend.py"))
    assert {"rod", "newton", "terms"} <= layers(DERJAX / "scene.py")
    assert TERM_MODULES


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_derjax_does_not_know_fitting(path):
    assert not [name for name in imports(path) if name.split(".")[0] == "fitting"]


@pytest.mark.parametrize("path", TERM_MODULES, ids=name_of)
def test_terms_import_only_what_they_are_made_of(path):
    assert not layers(path) & RIGHT_OF_TERMS
    assert not any(name.split(".")[0] == "fitting" for name in imports(path))


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


@pytest.mark.parametrize("path", TERM_MODULES, ids=name_of)
def test_every_term_says_what_it_is(path):
    assert ast.get_docstring(tree_of(path)), "the module has no docstring"


@pytest.mark.parametrize("path", TERM_MODULES, ids=name_of)
def test_every_term_is_in_the_registry(path):
    """`scene.py` imports each module of a term, and makes the term that it defines."""
    classes = [node for node in tree_of(path).body if isinstance(node, ast.ClassDef)]
    methods = {c.name: [f for f in c.body if isinstance(f, ast.FunctionDef)] for c in classes}
    terms = {name for name, own in methods.items() if "contribution" in {f.name for f in own}}
    assert terms, f"{name_of(path)} defines no term: it belongs somewhere else"
    registry = tree_of(DERJAX / "scene.py")
    calls = {
        node.func.id
        for node in ast.walk(registry)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    imported = {
        name.removeprefix(f"derjax.terms.{path.stem}.") for name in imports(DERJAX / "scene.py")
    }
    assert terms <= imported & calls


def test_the_version_is_the_same_everywhere():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    cited = re.search(r'^version: "?([^"\n]+)"?$', citation, re.MULTILINE)
    changed = re.search(r"^## \[?(\d+\.\d+\.\d+[^\]\s]*)\]?", changes, re.MULTILINE)
    assert cited
    assert changed
    assert cited[1] == changed[1] == project["version"]
