"""Numbers that follow from others where a scene file does not give them."""

import re
from typing import Any

import jax
import numpy as np
import pytest

from derjax import build
from derjax.core.errors import InputError
from derjax.integrate.step import Scene
from derjax.scenes.file import SceneFile
from derjax.scenes.ingredients.fluid import REGULARIZATION
from derjax.scenes.ingredients.friction import SLIP
from derjax.scenes.load import load_scene
from derjax.terms import Contact, Friction, StokesletSegments

COARSE = {"edge_length": 0.03}


def scene(**tables: Any) -> SceneFile:
    return SceneFile.model_validate({"robot": COARSE, **tables})


def term(built: Scene, kind: type) -> Any:
    (found,) = (t for t in built.terms if isinstance(t, kind))
    return found


def test_the_default_robot_has_the_regularization_that_it_had():
    assert SceneFile().parameters["regularization"] == pytest.approx(1.67e-3, rel=1e-15)


def test_the_regularization_follows_the_rod():
    thin = scene(robot=COARSE | {"rod_radius": 0.4e-3})
    assert thin.parameters["regularization"] == pytest.approx(0.4175e-3, rel=1e-15)
    stokeslets = term(build(scene(), {"rod_radius": 0.4e-3}), StokesletSegments)
    assert float(stokeslets.regularization) == pytest.approx(0.4175e-3, rel=1e-15)


def test_a_regularization_that_is_given_is_used():
    """Even where it is what the default would be."""
    file = scene(fluid={"regularization": 1.67e-3})
    stokeslets = term(build(file, {"rod_radius": 0.4e-3}), StokesletSegments)
    assert float(stokeslets.regularization) == 1.67e-3
    both = {"rod_radius": 0.4e-3, "regularization": 1e-3}
    assert scene().parameters_with(both)["regularization"] == 1e-3


def test_derivatives_go_through_what_follows():
    file = scene(robot={**COARSE, "kind": "two_flagella"}, friction={})

    def followers(numbers: dict[str, Any]) -> list[Any]:
        built = build(file, numbers)
        contact = term(built, Contact).stiffness
        blob = term(built, StokesletSegments).regularization
        return [blob, contact, term(built, Friction).slip_speed]

    at = {"rod_radius": 1.6e-3, "youngs_modulus": 1e6, "rpm": 30.0}
    value, slope = jax.jvp(followers, (at,), ({name: x for name, x in at.items()},))
    np.testing.assert_allclose(value, [1.67e-3, 1.6e3, SLIP * np.pi * 1.6e-3], rtol=1e-14)
    # Along the numbers themselves: a product of n of them grows n times as fast as each.
    np.testing.assert_allclose(slope, np.array(value) * [1, 2, 2], rtol=1e-14)


def test_a_stiffness_and_a_slip_speed_that_are_given_are_used():
    file = scene(
        robot={**COARSE, "kind": "two_flagella"},
        contact={"stiffness": 2008.0},
        friction={"slip_speed": 1e-3},
    )
    built = build(file, {"rod_radius": 1e-3, "rpm": 10.0})
    assert float(term(built, Contact).stiffness) == 2008.0
    assert float(term(built, Friction).slip_speed) == 1e-3


def test_friction_without_motion_asks_for_a_slip_speed(tmp_path):
    path = tmp_path / "scene.toml"
    for motor in ("rpm = 0", "table = 'motor.csv'"):
        (tmp_path / "motor.csv").write_text("time,rpm\n0,0\n20,0\n")
        path.write_text(f"[robot]\nkind = 'two_flagella'\n[friction]\n[motor]\n{motor}\n")
        with pytest.raises(InputError, match=re.escape(f"{path}: [friction] slip_speed: must be")):
            load_scene(path)
        path.write_text(
            f"{path.read_text()}[time]\n".replace("[friction]", "[friction]\nslip_speed = 1e-4")
        )
        assert load_scene(path).friction is not None


def test_resistive_force_theory_needs_no_regularization():
    """A mesh that is too fine for Stokeslet segments, and one that they are not asked about."""
    fine = {"helix_radius": 2e-7, "pitch": 2.3e-6, "axial_length": 5.4e-6, "rod_radius": 1e-8}
    fine |= {"edge_length": 2e-9, "head_radius": 7e-7}
    rft = scene(robot=fine, fluid={"hydrodynamics": "rft"})
    assert rft.parameters["regularization"] == pytest.approx(REGULARIZATION * 1e-8)
    scene(robot=fine, fluid={"hydrodynamics": "rft", "regularization": 1.67e-3})
