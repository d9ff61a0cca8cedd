"""Programs that are kept as they were traced: found again, the same, and never another one's."""

import json
import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quick
import xarray as xr

import derjax as dj
from derjax.core import programs
from derjax.core.fingerprint import Unknown, described
from derjax.core.programs import Stored, stored
from derjax.core.pytree import Indices, pytree, static

TRACED: list[str] = []
"""Names of functions, for each time that JAX has traced one."""


@pytree
class Pair:
    """Something to return: with leaves, and with structure."""

    first: jax.Array
    second: jax.Array
    places: Indices = static()


def twice(x):
    return 2.0 * x


def thrice(x):
    return 3.0 * x


def shared(power, pair: Pair, more):
    """A static argument, a tree and a list; the answer is a tree."""
    TRACED.append("shared")
    made = power(pair.first) if callable(power) else pair.first**power
    factor = jnp.linalg.cholesky(jnp.eye(3) * (2.0 + made[0]))
    return {"pair": Pair(made, factor, pair.places), "sum": sum(jnp.sum(x) for x in more)}


def arguments(**changes):
    given = {
        "power": 3,
        "first": jnp.arange(3.0),
        "places": [1, 2],
        "more": [jnp.ones(4)],
        **changes,
    }
    pair = Pair(given["first"], jnp.zeros(2), Indices(given["places"]))
    return given["power"], pair, given["more"]


@pytest.fixture(autouse=True)
def kept(tmp_path, monkeypatch):
    """A directory in which programs are kept, and a process that began after all was written."""
    monkeypatch.setattr(programs, "BEGAN", np.inf)
    before = programs._directory
    programs.keep_in(tmp_path / "kept")
    TRACED.clear()
    yield tmp_path / "kept"
    programs.keep_in(before)


def process(function=shared) -> Stored:
    """The function in another process, which has traced nothing yet."""
    return stored(function, static=(0,))


def same(one, other) -> None:
    assert jax.tree.structure(one) == jax.tree.structure(other)
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_a_second_process_traces_nothing_and_gets_the_same_bits(kept):
    expected = jax.jit(shared, static_argnums=0)(*arguments())
    TRACED.clear()
    same(process()(*arguments()), expected)
    assert len(TRACED) == len(list(kept.iterdir())) == 1
    again = process()
    same(again(*arguments()), expected)
    same(again.compile(*arguments())(*arguments()[1:]), expected)
    assert len(TRACED) == 1


def further(x: jax.Array) -> jax.Array:
    return x + 1.0


def test_what_comes_out_of_a_program_goes_into_the_same_one(kept, caplog):
    """It belongs to the device already, which compiles apart unless it is said of all."""
    function = stored(further)
    with jax.log_compiles(), caplog.at_level("WARNING"):
        same(function(function(jnp.zeros(3))), jnp.full(3, 2.0))
    assert sum("Compiling jit(further)" in r.message for r in caplog.records) == 1


def test_other_numbers_share_a_program(kept):
    process()(*arguments())
    other = arguments(first=jnp.array([4.0, 5.0, 6.0]))
    found = process()(*other)
    assert len(TRACED) == 1
    same(found, jax.jit(shared, static_argnums=0)(*other))


@pytest.mark.parametrize(
    "changes",
    [
        pytest.param({"power": 2}, id="static argument"),
        pytest.param({"power": twice}, id="static function"),
        pytest.param({"first": jnp.arange(4.0)}, id="shape"),
        pytest.param({"first": jnp.arange(3, dtype=np.float32)}, id="precision"),
        pytest.param({"places": [1, 3]}, id="static field"),
        pytest.param({"more": [jnp.ones(4), jnp.ones(4)]}, id="longer list"),
        pytest.param({"more": (jnp.ones(4),)}, id="tuple for list"),
        pytest.param({"more": [np.ones(4, np.int32)]}, id="kind of number"),
    ],
)
def test_another_structure_is_another_program(changes):
    process()(*arguments())
    found = process()(*arguments(**changes))
    assert len(TRACED) == 2
    same(found, jax.jit(shared, static_argnums=0)(*arguments(**changes)))


def test_what_was_compiled_for_one_class_never_runs_for_another():
    """Many of the same shape, with one function: what each makes of it is its own."""

    def number(k: int) -> type:
        @pytree
        class Number:
            leaf: jax.Array
            name: str = static(default="the same")

            def value(self) -> jax.Array:
                return self.leaf + k

        return Number

    numbers = [number(k)(jnp.zeros(())) for k in range(60)]
    structures = [jax.tree.structure(n) for n in numbers]
    assert all((a == b) == (a is b) for a in structures for b in structures)
    value = jax.jit(lambda n: n.value())
    assert [int(value(n)) for n in numbers * 2] == [*range(60)] * 2


def test_functions_are_told_apart_by_their_names():
    for power in (twice, thrice, twice, thrice):
        found = process()(*arguments(power=power))
        same(found["pair"].first, power(jnp.arange(3.0)))
    assert len(TRACED) == 2


@pytest.mark.parametrize("what", ["sources", "settings", "flags", "versions"])
def test_what_a_program_follows_from_is_part_of_its_name(monkeypatch, what):
    process()(*arguments())
    if what == "sources":
        monkeypatch.setattr(programs, "_digest_of_sources", lambda package: f"{package}, changed")
    elif what == "flags":
        monkeypatch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", "") + " --new")
    elif what == "versions":
        monkeypatch.setattr(programs, "version", lambda name: "0.0.1")
    with jax.default_matmul_precision("highest" if what == "settings" else None):
        process()(*arguments())
    assert len(TRACED) == 2


def test_the_sources_are_those_of_every_module(tmp_path, monkeypatch):
    """A change in any of them counts, and one that came while the process ran ends all keeping."""
    package = tmp_path / "robots_of_mine"
    (package / "deep").mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "deep" / "physics.py").write_text("A = 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    __import__("robots_of_mine")
    before = programs._digest_of_sources("robots_of_mine")
    (package / "deep" / "physics.py").write_text("A = 2\n")
    assert programs._digest_of_sources("robots_of_mine") != before
    monkeypatch.setattr(programs, "BEGAN", os.stat(package / "deep").st_mtime - 10.0)
    with pytest.raises(Unknown, match="changed since"):
        programs._digest_of_sources("robots_of_mine")


def test_sources_that_are_changed_while_a_program_is_traced_are_not_its_own(kept, monkeypatch):
    digests = iter("abcdefgh")
    monkeypatch.setattr(programs, "_digest_of_sources", lambda package: next(digests))
    process()(*arguments())
    assert not kept.exists()


def cut(content: bytes) -> bytes:
    return content[: len(content) // 2]


def flipped(content: bytes) -> bytes:
    return content[:-100] + bytes([content[-100] ^ 1]) + content[-99:]


def foreign(content: bytes) -> bytes:
    return b"something else"


def empty(content: bytes) -> bytes:
    return b""


@pytest.mark.parametrize("damage", [cut, flipped, foreign, empty])
def test_a_damaged_file_is_replaced(kept, damage):
    expected = process()(*arguments())
    (path,) = kept.iterdir()
    content = path.read_bytes()
    path.write_bytes(damage(content))
    same(process()(*arguments()), expected)
    assert len(TRACED) == 2
    same(process()(*arguments()), expected)
    assert len(TRACED) == 2
    assert list(kept.iterdir()) == [path]


def test_the_file_of_another_program_is_not_taken_for_this_one(kept):
    process()(*arguments(power=2))
    (other,) = kept.iterdir()
    process()(*arguments(power=3))
    (path,) = set(kept.iterdir()) - {other}
    path.write_bytes(other.read_bytes())
    found = process()(*arguments(power=3))
    assert len(TRACED) == 3
    same(found["pair"].first, jnp.arange(3.0) ** 3)


@pytest.mark.parametrize(
    "power",
    [
        pytest.param(lambda x: 2.0 * x, id="without a name"),
        pytest.param(partial(lambda a, x: a * x, 2.0), id="without a name, partly given"),
        pytest.param(jnp.square, id="of another package"),
    ],
)
def test_what_is_not_known_is_traced_as_ever(kept, power):
    with pytest.raises(Unknown):
        described(power, frozenset({"derjax", "test_programs"}))
    found = process()(*arguments(power=power))
    same(found["pair"].first, power(jnp.arange(3.0)))
    assert TRACED
    assert not kept.exists()


def test_the_terms_of_other_packages_are_traced_as_ever():
    """Their sources, and what these depend on, are not part of a program's name."""
    scene = dj.build(dj.SceneFile.from_dict({"fluid": {"hydrodynamics": "rft"}}))
    known = frozenset({"derjax"})
    assert programs.leaves_described(scene, known)[1] == len(jax.tree.leaves(scene))
    own = dj.Energy(twice, nodes=(0,))
    with pytest.raises(Unknown):
        programs.leaves_described(scene.with_term(own), known)


def test_a_directory_that_cannot_be_written_to_costs_nothing_else(tmp_path):
    (tmp_path / "file").write_text("in the way")
    programs.keep_in(tmp_path / "file" / "kept")
    expected = jax.jit(shared, static_argnums=0)(*arguments())
    same(process()(*arguments()), expected)


def test_a_directory_does_not_grow_for_ever(kept, monkeypatch):
    for power in (2, 3, 4):
        process()(*arguments(power=power))
        os.utime(max(kept.iterdir(), key=lambda p: p.stat().st_ctime), (power, power))
    size = max(path.stat().st_size for path in kept.iterdir())
    monkeypatch.setattr(programs, "MOST_BYTES", int(2.5 * size))
    process()(*arguments(power=5))
    assert len(list(kept.iterdir())) == 2
    TRACED.clear()
    process()(*arguments(power=4))
    process()(*arguments(power=5))
    assert not TRACED


def test_derivatives_and_batches_go_through_the_function_itself():
    def total(function, x):
        return jnp.sum(function(*arguments(first=x))["pair"].first)

    program, plain = process(), jax.jit(shared, static_argnums=0)
    x = jnp.arange(3.0)
    program(*arguments())
    for transformed in (jax.grad, jax.hessian, jax.jit):
        same(transformed(partial(total, program))(x), transformed(partial(total, plain))(x))
    many = jnp.stack([x, 2 * x])
    same(jax.vmap(partial(total, program))(many), jax.vmap(partial(total, plain))(many))


def test_what_tracing_raises_is_raised_once_and_nothing_is_kept(kept):
    def wrong(power):
        TRACED.append("wrong")
        raise dj.InputError("there is no such robot")

    with pytest.raises(dj.InputError, match="no such robot"):
        process()(*arguments(power=wrong))
    assert TRACED.count("wrong") <= 2


SCENE = """
[robot]
kind = "clamped"
n_flagella = 1
axial_length = 0.03
edge_length = 0.01
[motor]
rpm = 60.0
[time]
step = 0.02
end = 0.08
frame = 0.04
"""


COMMAND = "import sys; from derjax.commands.main import main; sys.exit(main())"
ALONE = """
import sys, pathlib
from derjax.runs.simulation import Options, simulate
simulate(Options(pathlib.Path(sys.argv[2]), pathlib.Path(sys.argv[4]), figures=False))
"""


def run(program: str, directory: Path, output: str, scene: str = SCENE) -> tuple[xr.Dataset, str]:
    """`derjax simulate` in a process of its own, and what JAX says of what it traces."""
    (directory / "scene.toml").write_text(scene)
    environment = quick.environment() | {
        "JAX_COMPILATION_CACHE_DIR": str(directory / "cache"),
        "JAX_LOG_COMPILES": "1",
    }
    words = ["simulate", str(directory / "scene.toml"), "-o", str(directory / output)]
    command = [sys.executable, "-c", program, *words, "--no-figures"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert json.loads((directory / output / "summary.json").read_text())["status"] == "ok"
    with xr.open_dataset(directory / output / "trajectory.nc") as trajectory:
        return trajectory.load(), done.stderr


@pytest.mark.slow
def test_a_command_traces_nothing_twice(tmp_path):
    """Its results are those of a process that keeps no programs, bit by bit.

    Other numbers, and another end, share the program of the steps.
    """
    plain, said = run(ALONE, tmp_path, "plain")
    assert "tracing march_frames" in said
    assert not (tmp_path / "cache" / "traced").exists()
    _, said = run(COMMAND, tmp_path, "first")
    assert "tracing flat" in said
    kept = set((tmp_path / "cache" / "traced").glob("march_frames-*"))
    second, said = run(COMMAND, tmp_path, "second")
    assert "tracing flat" not in said
    for name in plain.variables:
        np.testing.assert_array_equal(plain[name], second[name])
    others = SCENE.replace("60.0", "90.0").replace("end = 0.08", "end = 0.12")
    faster, _ = run(COMMAND, tmp_path, "faster", others)
    assert faster.motor_angle[-1] > 2.0 * second.motor_angle[-1]
    assert len(kept) == 1
    assert set((tmp_path / "cache" / "traced").glob("march_frames-*")) == kept
