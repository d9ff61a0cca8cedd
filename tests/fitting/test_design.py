"""Design: gradients of what a robot achieves, and better robots within bounds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from derjax import InputError, roll_frames
from fitting.design import design, efficiency, speed
from fitting.simulate import build_with
from fitting.transforms import select_parameters

NAMES = ("pitch", "helix_radius")


@pytest.fixture(scope="module")
def short(scene):
    return scene.model_copy(update={"time": scene.time.model_copy(update={"end": 1.0})})


@pytest.fixture(scope="module")
def merits(short):
    """Speed and efficiency, their gradients and the motion at logarithms of pitch and radius."""
    parameters = select_parameters(NAMES, short.parameters)

    def both(free):
        built, state = build_with(short, parameters, free, jnp.array(60.0))
        frames, _ = roll_frames(built, state, short.n_frames, short.steps_per_frame)
        found = jnp.stack([speed(built, frames), efficiency(built, frames)])
        return found, (found, frames)

    compiled = jax.jit(jax.jacrev(both, has_aux=True))

    def function(free):
        gradient, (found, frames) = compiled(jnp.asarray(free))
        return np.asarray(found), np.asarray(gradient), frames

    return function, parameters.free(short.parameters)


def test_gradients_are_those_of_finite_differences(merits) -> None:
    function, free = merits
    gradient = function(free)[1]
    h = 1e-4
    for i, along in enumerate(np.eye(2)):
        slope = (function(free + h * along)[0] - function(free - h * along)[0]) / (2 * h)
        assert gradient[:, i] == pytest.approx(slope, rel=1e-4)


def test_speed_and_efficiency_are_what_they_say(merits) -> None:
    function, free = merits
    (found_speed, found_efficiency), _, frames = function(free)
    path = np.asarray(frames.q)[:, :3]
    duration = float(frames.time[-1] - frames.time[0])
    assert found_speed == pytest.approx(np.linalg.norm(path[-1] - path[0]) / duration)
    spin = float(frames.q[-1, 27] - frames.q[0, 27]) / duration
    power = 8 * np.pi * 0.031**3 * abs(spin) * 2 * np.pi  # viscosity 1, C_r 1, a turn a second
    assert found_efficiency == pytest.approx(6 * np.pi * 0.031 * found_speed**2 / power)
    assert 0 < found_efficiency < 0.1


def test_a_better_design_is_found_within_bounds(short) -> None:
    bounds = {"pitch": (0.03, 0.06), "helix_radius": (5e-3, 8e-3)}
    seen = []
    found = design(
        short,
        speed,
        bounds,
        steps=5,
        rate=0.3,
        on_step=lambda k, merit, values: seen.append(values),
    )
    assert found.merit > 1.05 * found.merits[0]
    assert found.merit == max(found.merits)
    assert set(found.values) == set(NAMES)
    for values in [*seen, found.values]:
        for name, (low, high) in bounds.items():
            assert low < values[name] < high
    assert seen[0] == pytest.approx({name: short.parameters[name] for name in NAMES})


@pytest.mark.parametrize(
    ("bounds", "says"),
    [
        ({"pitch": (0.05, 0.06)}, "pitch = 0.0445: must be between 0.05 and 0.06"),
        ({"pitch": (0.06, 0.05)}, "0.06 is not less than 0.05"),
        ({"pich": (0.0, 1.0)}, "no parameter 'pich'"),
    ],
)
def test_wrong_bounds(short, bounds, says) -> None:
    with pytest.raises(InputError, match=says):
        design(short, speed, bounds)
