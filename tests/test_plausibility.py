"""Numbers in the wrong unit are refused, robots of another size are not."""

from pathlib import Path
from typing import Any

import pytest

from derjax.core.errors import InputError
from derjax.scenes.file import SceneFile
from derjax.scenes.messages import check
from derjax.scenes.plausibility import USUAL_LENGTHS

IN_MM = {key: 1e3 * value for key, value in USUAL_LENGTHS.items()}


def read(content: dict[str, Any]) -> SceneFile:
    return check(SceneFile, content, Path("scene.toml"))


def complaint(content: dict[str, Any]) -> str:
    with pytest.raises(InputError) as caught:
        read(content)
    return str(caught.value)


@pytest.mark.parametrize("key", sorted(set(USUAL_LENGTHS) - {"separation"}))
def test_a_length_in_millimetres_is_refused(key):
    said = complaint({"robot": {key: IN_MM[key]}})
    assert said.startswith(f"scene.toml: [robot] {key} = {IN_MM[key]:g}: lengths are in metres")
    assert f"did you mean {USUAL_LENGTHS[key]:g}?" in said
    everything = USUAL_LENGTHS | {key: IN_MM[key]}
    assert f"[robot] {key} = " in complaint({"robot": everything})


def test_all_lengths_in_millimetres_are_told_at_once():
    shape = {key: IN_MM[key] for key in ("pitch", "helix_radius", "axial_length")}
    said = complaint({"robot": shape})
    assert "[robot] helix_radius = 6.4" in said
    assert said.endswith("did you mean 0.0064? So for pitch, axial_length")


def test_the_separation_counts_where_there_are_several_flagella():
    robot = {"kind": "two_flagella", "separation": 28.0}
    assert "[robot] separation = 28: lengths are in metres" in complaint({"robot": robot})
    read({"robot": {"separation": 28.0}})


@pytest.mark.parametrize("length", [0.5, 1.5, 4.0])
def test_a_long_rod_is_accepted(length):
    """Also with a modulus that no millionfold of could be meant."""
    rod = {"kind": "clamped", "n_flagella": 1, "shape": "straight", "axial_length": length}
    read({"robot": rod | {"rod_radius": 5e-3, "edge_length": 1e-2}})
    read({"robot": rod})


@pytest.mark.parametrize("exponent", range(-6, 7))
@pytest.mark.parametrize("kind", ["single_flagellum", "two_flagella", "clamped"])
@pytest.mark.parametrize("given", [True, False])
def test_robots_of_all_sizes_are_accepted(exponent, kind, given):
    """Scaled so that Reynolds number and elastic over viscous forces are the same."""
    scale = 10.0**exponent
    robot = {key: scale * length for key, length in USUAL_LENGTHS.items()}
    densities = {"density": 1260 / scale**2, "fluid_density": 1260 / scale**2}
    fluid = {"regularization": 1.67e-3 * scale} if given else {}
    scene = read(
        {
            "robot": robot | {"kind": kind} | ({"n_flagella": 2} if kind == "clamped" else {}),
            "material": {"density": densities["density"]},
            "fluid": fluid | {"fluid_density": densities["fluid_density"]},
        }
    )
    assert scene.edge / scale == pytest.approx(SceneFile().edge, rel=1e-12)


@pytest.mark.parametrize(
    ("material", "fluid", "accepted"),
    [
        ({"density": 1.26}, {}, False),
        ({"density": 1.26}, {"fluid_density": 0.0}, False),
        ({"density": 1.26}, {"fluid_density": 1.26}, True),
        ({"density": 1260.0}, {"fluid_density": 1.2}, True),  # in air
        ({"density": 50.0}, {}, True),  # a foam
    ],
)
def test_densities_are_compared_with_the_fluid(material, fluid, accepted):
    content = {"material": material, "fluid": fluid}
    if accepted:
        read(content)
    else:
        expected = (
            "scene.toml: [material] density = 1.26: densities are in kg/m^3; did you mean 1260?"
        )
        assert complaint(content) == expected


@pytest.mark.parametrize(
    ("modulus", "rpm", "accepted"),
    [
        (1.255, 60.0, False),
        (1.255, -60.0, False),
        (10.0, 60.0, False),
        (1.255, 0.0, True),  # nothing bends it
        (1e3, 60.0, True),
        (50e9, 60.0, True),
    ],
)
def test_moduli_are_compared_with_viscous_forces(modulus, rpm, accepted):
    content = {"material": {"youngs_modulus": modulus}, "motor": {"rpm": rpm}}
    if accepted:
        read(content)
        return
    said = f"scene.toml: [material] youngs_modulus = {modulus:g}: moduli are in pascals; "
    assert complaint(content) == said + f"did you mean {1e6 * modulus:g}?"


def test_a_bacterium_is_accepted():
    robot = {"helix_radius": 0.2e-6, "pitch": 2.3e-6, "axial_length": 5.4e-6}
    robot |= {"rod_radius": 0.01e-6, "edge_length": 0.1e-6, "head_radius": 0.7e-6}
    scene = read(
        {
            "robot": robot,
            "material": {"youngs_modulus": 4.5e8},
            "fluid": {"viscosity": 1e-3, "hydrodynamics": "rft"},
            "motor": {"rpm": 13_200.0},
            "time": {"end": 0.1},
        }
    )
    assert scene.n_frames == 200
    assert scene.step == pytest.approx(2.5e-4)
