"""Results are those of the numbers that were run, wherever they came from."""

import json
import os
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

from derjax import InputError, Scene, SceneFile, State, build, march_frames
from derjax.core.pytree import replace
from derjax.results.dataset import to_dataset, write
from derjax.results.summary import summarise
from derjax.runs.batch import build_many, pick
from derjax.scenes.build import build_unchecked
from derjax.scenes.motortable import RateTable
from derjax.scenes.parameters import PLACES
from derjax.scenes.shape import touching_pairs
from derjax.terms import Contact, HeadDrag

SCENES: dict[str, dict[str, Any]] = {
    "single": {"robot": {"edge_length": 0.03}, "time": {"step": 0.02, "end": 0.08}},
    "arcs": {
        "robot": {"kind": "two_flagella", "shape": "arc", "bend": 0.2, "edge_length": 0.03},
        "motor": {"rpm": [60.0, 50.0]},
        "friction": {},
        "gravity": {},
    },
    "limited": {
        "robot": {"edge_length": 0.03},
        "motor": {"stall_torque": 1e-3, "free_rpm": 90.0, "ripple": 0.1},
    },
}
OTHERS = {"C_t": 2.0, "C_r": 0.1, "poisson_ratio": 0.4, "density": 1300.0, "axial_length": 0.1}
"""Values of parameters; of others nine tenths of what they are."""


def scene_file(name: str) -> SceneFile:
    return SceneFile.model_validate(SCENES[name])


def other_value(file: SceneFile, name: str) -> Any:
    if name in OTHERS:
        return OTHERS[name]
    return (0.9 * np.asarray(file.parameters[name])).tolist()


def moving(scene: Scene, start: State) -> State:
    """Made-up states, in which all robots of one mesh move alike."""

    def at(time: jax.Array) -> State:
        there = start.q + time * jnp.cos(jnp.arange(start.q.size)) * 1e-3
        return replace(start, q=there, time=time)

    return jax.vmap(at)(jnp.linspace(0.0, 1.0, 5))


def with_value(name: str, parameter: str, value: Any) -> SceneFile:
    """A scene file in which a parameter stands."""
    table, key = PLACES[parameter].split(".")
    tables = {k: dict(v) for k, v in SCENES[name].items()}
    tables.setdefault(table, {})[key] = value
    return SceneFile.model_validate(tables)


EVERY = {name: scene for scene in reversed(SCENES) for name in scene_file(scene).parameters}
"""Every parameter, and the first scene that has it."""


def test_every_parameter_is_among_them():
    assert EVERY.keys() == PLACES.keys()


@pytest.mark.parametrize(("parameter", "name"), EVERY.items())
def test_an_override_has_the_results_of_a_file_with_that_value(name, parameter):
    file = scene_file(name)
    value = other_value(file, parameter)
    given = with_value(name, parameter, value)
    overridden = build(file, {parameter: value})
    state = overridden.start
    expected = build(given)
    other = expected.start
    # The mesh and the steps of an override are those of the file.
    if state.q.size != other.q.size:
        expected = build(given.model_copy(update={"robot": file.robot}), dict(given.parameters))
        other = expected.start
    states = moving(overridden, state)
    dataset = to_dataset(overridden, states)
    reference = to_dataset(expected, states)
    assert "changed_terms" not in dataset.attrs
    xr.testing.assert_identical(dataset, reference)
    assert dataset.attrs.keys() == reference.attrs.keys()
    for key, found in dataset.attrs.items():
        np.testing.assert_array_equal(found, reference.attrs[key], key)
    np.testing.assert_array_equal(dataset.attrs[parameter], value)
    table, key = PLACES[parameter].split(".")
    np.testing.assert_array_equal(json.loads(dataset.attrs["scene_json"])[table][key], value)
    assert summarise(dataset) == summarise(reference)


def test_efficiency_is_that_of_the_head_that_was_dragged():
    numbers = {"C_t": 2.0, "C_r": 0.1, "head_radius": 0.02}
    times = {"step": 0.05, "end": 1.0}
    file = SceneFile.model_validate(
        {"robot": {"edge_length": 0.03}, "fluid": {"hydrodynamics": "rft"}, "time": times}
    )
    scene = build(file, numbers)
    state = scene.start
    states, _ = jax.jit(march_frames, static_argnums=(2, 3))(scene, state, 4, 1)
    found = summarise(to_dataset(scene, states))
    ratio = 0.75 * 2.0 / 0.1 / 0.02
    motion = abs(found["v_x_m_per_s"] / found["head_rate_rad_per_s"])
    assert found["efficiency"] == pytest.approx(ratio * motion, rel=1e-12)
    assert found["efficiency"] == pytest.approx(0.0694, abs=1e-4)
    assert found["propulsive_force_N"] == pytest.approx(
        6 * np.pi * 0.02 * 2.0 * found["v_x_m_per_s"]
    )


def test_terms_that_acted_win():
    """A head whose drag is replaced: results are those of the term, and say that it was."""
    file = scene_file("single")
    scene = build(file)
    state = scene.start
    doubled = tuple(
        replace(t, translation=2 * t.translation) if isinstance(t, HeadDrag) else t
        for t in scene.terms
    )
    changed = replace(scene, terms=doubled)
    states = moving(scene, state)
    before, after = (to_dataset(s, states) for s in (scene, changed))
    assert "changed_terms" not in before.attrs
    assert after.attrs["changed_terms"] == "HeadDrag"
    ratio = summarise(after)["propulsive_force_N"] / summarise(before)["propulsive_force_N"]
    assert ratio == pytest.approx(2.0)
    more = replace(scene, terms=(*scene.terms, scene.terms[-1]))
    assert to_dataset(more, states).attrs["changed_terms"] == type(scene.terms[-1]).__name__
    without = replace(scene, terms=[t for t in scene.terms if not isinstance(t, HeadDrag)])
    dataset = to_dataset(without, states)
    assert dataset.attrs["changed_terms"] == "HeadDrag"
    assert summarise(dataset)["propulsive_force_N"] is None


def test_drags_of_one_head_add_up():
    file = scene_file("single")
    scene = build(file)
    state = scene.start
    (drag,) = (t for t in scene.terms if isinstance(t, HeadDrag))
    twice = replace(scene, terms=(*scene.terms, drag))
    states = moving(scene, state)
    once, both = (summarise(to_dataset(s, states)) for s in (scene, twice))
    assert both["propulsive_force_N"] == pytest.approx(2 * once["propulsive_force_N"])
    assert both["efficiency"] == pytest.approx(once["efficiency"])


def test_forces_of_all_contacts_add_up():
    file = SceneFile.model_validate({"robot": {"kind": "two_flagella", "edge_length": 0.03}})
    scene = build(file)
    state = scene.start
    (contact,) = (t for t in scene.terms if isinstance(t, Contact))
    # Rods as thick as their distance touch.
    thick = replace(contact, radius=jnp.asarray(0.02))
    states = moving(scene, state)
    forces = [
        to_dataset(replace(scene, terms=terms), states).contact_force.to_numpy()
        for terms in ((thick,), (thick, thick))
    ]
    assert (forces[0] > 0).all()
    np.testing.assert_allclose(forces[1], 2 * forces[0])


def test_batches_have_a_record_for_every_run():
    file = scene_file("single")
    scenes = build_many(file, {"C_t": [1.0, 2.0]})
    states = scenes.start
    one = jax.tree.map(np.asarray, pick(scenes, 1))
    run = moving(one, pick(states, 1))
    assert to_dataset(one, run, file=file).attrs["C_t"] == 2.0


@pytest.mark.parametrize(
    ("name", "numbers", "said"),
    [
        ("single", {"rod_radius": -1.0}, r"\[robot\] rod_radius = -1"),
        ("single", {"rod_radius": 1.6}, r"\[robot\] rod_radius = 1.6.*0.0016"),
        ("single", {"C_t": float("nan")}, r"\[head\] C_t = nan"),
        ("single", {"rpm": 1e7}, r"\[motor\] rpm = 1e\+07: beyond any motor"),
        ("single", {"viscosity": [1.0, 2.0]}, r"\[fluid\] viscosity"),
        ("single", {"regularization": 0.05}, r"\[fluid\] regularization = 0.05"),
        ("arcs", {"separation": 3.3e-3, "bend": -6.0}, r"two parts of the robot overlap"),
        ("arcs", {"separation": 3e-3}, r"\[robot\] separation = 0.003: the flagella overlap"),
        ("arcs", {"rpm": [0.0, 0.0]}, r"\[friction\] slip_speed"),
    ],
)
def test_an_override_is_checked_as_if_it_stood_in_the_file(name, numbers, said):
    with pytest.raises(InputError, match=said):
        build(scene_file(name), numbers)


def test_what_is_traced_or_not_to_be_checked_is_not():
    file = scene_file("single")
    for make in (
        lambda c: build_unchecked(file, {"C_t": c}),
        jax.jit(lambda c: build(file, {"C_t": c})),
    ):
        scene = make(-1.0)
        assert float(scene.parameters["C_t"]) == -1.0


def test_edges_that_may_touch_are_those_of_the_override():
    file = SceneFile.model_validate(
        {"robot": {"edge_length": 0.012}, "contact": {"method": "smooth"}}
    )
    thin = build(file, {"rod_radius": 0.5e-3})
    (contact,) = (t for t in thin.terms if isinstance(t, Contact))
    narrow = file.with_parameters({"rod_radius": 0.5e-3})
    assert contact.pairs == touching_pairs(narrow)
    assert contact.pairs != touching_pairs(
        SceneFile.model_validate(
            {"robot": {"edge_length": 0.012, "rod_radius": 6e-3}, "contact": {"method": "smooth"}}
        )
    )


def test_rates_of_a_motor_table_are_overridden_together(tmp_path):
    table = RateTable(time=(0.0, 30.0), rpm=((60.0, 50.0), (60.0, 60.0)))
    robot = {"kind": "two_flagella", "edge_length": 0.03}
    file = SceneFile.model_validate({"robot": robot}).model_copy(update={"motor_table": table})
    rates = [[30.0, 10.0], [20.0, 10.0]]
    scene = build(file, {"rpm": rates})
    state = scene.start
    dataset = to_dataset(scene, moving(scene, state))
    np.testing.assert_array_equal(dataset.attrs["rpm"], rates)
    np.testing.assert_allclose(dataset.motor_rate[0], np.array(rates[0]) * 2 * np.pi / 60)
    write(dataset, tmp_path / "trajectory.nc")
    with pytest.raises(InputError, match="rpm"):
        build(file, {"rpm": [[2e7, 0.0], [0.0, 0.0]]})


def test_what_names_a_compiled_program_is_the_same_in_every_process():
    """Check sums are part of what `build` returns, and so of the name under which it is kept."""
    program = (
        "import derjax as dj; print(sorted(dj.build(dj.robots.single_flagellum()).check_sums))"
    )
    said = {
        subprocess.run(
            [sys.executable, "-c", program],
            env=os.environ | {"PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    }
    assert len(said) == 1
