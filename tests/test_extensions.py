"""A physical ingredient of another package, as docs/add_an_ingredient.md describes it."""

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import derjax as dj
from derjax.commands.main import main
from derjax.scenes import extensions

PAGE = Path(__file__).parents[1] / "docs" / "add_an_ingredient.md"
PYTHON, TOML = (
    re.findall(f"```{kind}\n(.*?)```", PAGE.read_text(), re.S) for kind in ("python", "toml")
)

SCENE = """
[robot]
edge_length = 0.025
[fluid]
hydrodynamics = "rft"
[time]
step = 0.02
end = 0.2
frame = 0.02
"""


def installed(place: Path, module: str, entry: str) -> None:
    """A package as an installer leaves it."""
    (place / "derjax_trap.py").write_text(module)
    info = place / "derjax_trap-0.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: derjax-trap\nVersion: 0.1\n")
    (info / "entry_points.txt").write_text(f"[derjax.terms]\ntrap = {entry}\n")


@pytest.fixture
def trap(tmp_path_factory, monkeypatch) -> Iterator[None]:
    """The package of the page is installed."""
    place = tmp_path_factory.mktemp("site")
    installed(place, PYTHON[2], "derjax_trap:Trap")
    monkeypatch.syspath_prepend(place)
    extensions.forget()
    yield
    sys.modules.pop("derjax_trap", None)
    monkeypatch.undo()
    extensions.forget()


@pytest.fixture
def scene_path(tmp_path) -> Path:
    path = tmp_path / "scene.toml"
    path.write_text(SCENE + TOML[1])
    return path


@pytest.mark.slow
def test_the_other_ways_of_the_page():
    """Its first two blocks run as they stand."""
    names: dict = {}
    exec(PYTHON[0] + PYTHON[1], names)
    assert names["scene"][dj.Energy].nodes == (-1,)
    pull = names["Pull"](jnp.array([1e-3, 0.0, 0.0]), jnp.array(1.0))
    tables = {"fluid": {"hydrodynamics": "rft"}, "time": {"step": 0.02, "end": 0.04}}
    scene = dj.build(dj.robots.single_flagellum(edge_length=0.025, **tables))
    free, pulled = (dj.rollout(s, reverse_mode=False) for s in (scene, scene.with_term(pull)))
    assert float(pulled.positions[-1, -1, 0] - free.positions[-1, -1, 0]) > 1e-6


def test_the_package_declares_what_the_page_says():
    assert 'trap = "derjax_trap:Trap"' in TOML[0]


@pytest.mark.usefixtures("trap")
def test_a_scene_file_has_the_table(scene_path):
    file = dj.load_scene(scene_path)
    assert file.parameters["trap.stiffness"] == 0.2
    assert dj.SceneFile.from_dict(file.model_dump(exclude_unset=True)) == file
    scene = dj.build(file, {"trap.stiffness": 0.3})
    assert float(scene[dj.Energy].data[0]) == 0.3
    again = scene.replace(**{"trap.stiffness": 0.2})
    run, free = (
        dj.rollout(again, reverse_mode=False),
        dj.rollout(
            dj.build(
                dj.SceneFile.from_dict(
                    {k: v for k, v in file.model_dump(exclude_unset=True).items() if k != "trap"}
                )
            ),
            reverse_mode=False,
        ),
    )
    gap = np.array([0.12, 0.0, 0.0]) - free.positions[-1, -1]
    assert float((run.positions[-1, -1] - free.positions[-1, -1]) @ gap) > 0
    attributes = run.to_dataset().attrs
    assert attributes["trap.stiffness"] == 0.2
    assert "trap.stiffness: N/m" in attributes["parameter_units"]
    assert json.loads(attributes["scene_json"])["trap"]["stiffness"] == 0.2


@pytest.mark.slow
@pytest.mark.usefixtures("trap")
def test_derivatives_by_its_numbers_with_both_solvers(scene_path):
    content = dj.load_scene(scene_path).model_dump(exclude_unset=True)
    slopes = []
    for solver in ("dense", "blocks"):
        file = dj.SceneFile.from_dict(content | {"solver": {"method": solver}})

        def end(stiffness, file=file):
            run = dj.rollout(dj.build(file, {"trap.stiffness": stiffness}), end=0.06)
            return run.positions[-1, -1, 0]

        both = jax.jit(lambda stiffness, end=end: jax.jvp(end, (stiffness,), (1.0,)))
        slopes.append(float(both(0.2)[1]))
        if solver == "dense":
            ends = [float(both(0.2 + s * 1e-4)[0]) for s in (-1, 1)]
            assert slopes[0] == pytest.approx((ends[1] - ends[0]) / 2e-4, rel=1e-5)
    assert slopes[1] == pytest.approx(slopes[0], rel=1e-6)


@pytest.mark.slow
@pytest.mark.usefixtures("trap")
def test_a_sweep_and_a_fit_over_its_number(scene_path, tmp_path):
    """The fit finds the stiffness with which the track was made."""
    sweep = tmp_path / "sweep.toml"
    sweep.write_text('scene = "scene.toml"\n[vary]\n"trap.stiffness" = [0.1, 0.4]\n')
    assert main(["sweep", str(sweep), "-o", str(tmp_path / "sweep"), "--quiet"]) == 0
    table = pd.read_csv(next((tmp_path / "sweep").glob("*.csv")))
    assert list(table["trap.stiffness"]) == [0.1, 0.4]
    assert table["tail_to_head_m"].nunique() == 2
    truth = dj.rollout(dj.build(dj.load_scene(scene_path)), reverse_mode=False)
    rng = np.random.default_rng(1)
    track = pd.DataFrame(np.asarray(truth.head_position[1:]), columns=["x", "y", "z"])
    track += 1e-7 * rng.normal(size=track.shape)
    track.insert(0, "time", np.asarray(truth.time[1:]))
    track.to_csv(tmp_path / "track.csv", index=False)
    (tmp_path / "start.toml").write_text(SCENE + TOML[1].replace("0.2", "0.1"))
    columns = '{ t = "time", x = "x", y = "y", z = "z" }'
    (tmp_path / "dataset.toml").write_text(
        f'scene = "start.toml"\n[[runs]]\ntrack = "track.csv"\ncolumns = {columns}\n'
    )
    fit = ["fit", str(tmp_path / "dataset.toml"), "-o", str(tmp_path / "fit"), "--quiet"]
    assert main([*fit, "--parameters", "trap.stiffness"]) == 0
    found = json.loads((tmp_path / "fit" / "fit.json").read_text())["parameters"]["trap.stiffness"]
    assert abs(found["value"] - 0.2) < 4 * found["std"]
    assert found["std"] < 0.02
    assert found["unit"] == "N/m"


@pytest.mark.usefixtures("trap")
@pytest.mark.parametrize(
    ("table", "said"),
    [
        (
            "[trap]\nstifness = 1.0\n",
            r"toml: \[trap\] stifness: unknown key. Did you mean 'stiff",
        ),
        (
            "[trap]\nstiffness = -1.0\n",
            r"\[trap\] stiffness = -1.0: should be greater than 0",
        ),
        ("[trapp]\nstiffness = 1.0\n", r"\[trapp\]: unknown table. Did you mean \[trap\]\?"),
        ("trap = 3\n", r"\[trap\]: should be a table"),
    ],
)
def test_wrong_input_is_named(table, said, tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(table)
    with pytest.raises(dj.InputError, match=said):
        dj.load_scene(path)


@pytest.mark.parametrize(
    ("module", "said"),
    [
        ("import nothing_of_it", "of the package derjax-trap cannot be imported: ModuleNotFound"),
        ("Trap = 3", "is no derjax Extension"),
    ],
)
def test_a_package_that_does_not_work(module, said, tmp_path, monkeypatch, scene_path):
    """Says so where its table is used, and nowhere else."""
    site = tmp_path / "site"
    site.mkdir()
    installed(site, module, "derjax_trap:Trap")
    monkeypatch.syspath_prepend(site)
    extensions.forget()
    try:
        assert dj.SceneFile.from_dict({}).extensions == ()
        with pytest.raises(dj.InputError, match=said):
            dj.load_scene(scene_path)
    finally:
        sys.modules.pop("derjax_trap", None)
        monkeypatch.undo()
        extensions.forget()


@pytest.mark.usefixtures("trap")
def test_new_scenes_show_the_table(tmp_path):
    assert main(["new", str(tmp_path / "robot")]) == 0
    text = (tmp_path / "robot" / "scene.toml").read_text()
    assert "# [trap]   # A spring between a node and a place" in text
    assert "# stiffness = '...'   # N/m" in text
