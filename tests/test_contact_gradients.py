"""Derivatives through hundreds of steps in which flagella touch, slide and part again.

The robot is as small as it can be: nine edges to a flagellum, and axes 8 mm apart, so that two
helices of 6.4 mm radius are nested in each other. They do not touch at the start, but soon do,
and at different rates they stay in contact in most of the steps. The run ends before the motion
has become chaotic: only then are there finite differences to compare with. Central
differences need steps of 1e-5 of a parameter or less, as larger ones change which edges meet; the
stiffness of contacts, which hardly matters, takes larger ones.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import derjax
from derjax.rods.head import head_position
from derjax.scenes.file import SceneFile
from derjax.terms.contact.repulsion import Contact
from derjax.terms.contact.segments import distance

NAMES = ("C_t", "C_r", "friction", "contact_stiffness", "pitch")
DIFFERENCES = (1e-5, 1e-5, 1e-5, 1e-3, 5e-6)
WEIGHTS = jnp.array([1.0, 0.5, -0.25])
STEPS = 10
FRAMES = {"rft": 30, "rss": 50}
AT = jnp.ones(len(NAMES))


def nested(hydrodynamics: str) -> SceneFile:
    return SceneFile.model_validate(
        {
            "robot": {
                "kind": "two_flagella",
                "edge_length": 15e-3,
                "separation": 8e-3,
                "pitch": 31.8e-3,
                "phase": [np.pi, np.pi - 0.4],
            },
            "fluid": {"hydrodynamics": hydrodynamics},
            "motor": {"rpm": [60.0, 50.0]},
            "contact": {"stiffness": 1e4, "capacity": 60},
            "friction": {"coefficient": 0.3},
            "time": {"step": 5e-3, "end": 2.5, "inertia": False},
            "solver": {"tolerance": 1e-11},
        }
    )


def head_at_the_end(file: SceneFile, relative: jax.Array, roll=derjax.roll_frames):
    """Position of the head (m) after some frames, and what else happened.

    `relative` are the parameters in units of their values in the scene.
    """
    values = {name: file.parameters[name] * relative[i] for i, name in enumerate(NAMES)}
    scene = derjax.build(file, values)
    state = scene.start
    states, report = roll(scene, state, FRAMES[file.fluid.hydrodynamics], STEPS)
    q = jnp.concatenate([state.q[None], states.q])
    return head_position(scene.rod.topology, states)[-1], (scene, q, report)


position = jax.jit(partial(head_at_the_end, roll=derjax.march_frames), static_argnums=0)
forward_mode = jax.jit(jax.jacfwd(head_at_the_end, argnums=1, has_aux=True), static_argnums=0)


@partial(jax.jit, static_argnums=0)
def reverse_mode(file: SceneFile, relative: jax.Array):
    """Derivative of a mixture of the head's coordinates."""

    def mixture(relative):
        end, (_, _, report) = head_at_the_end(file, relative)
        return WEIGHTS @ end, report

    return jax.grad(mixture, has_aux=True)(relative)


def touching(scene: derjax.Scene, q: jax.Array) -> np.ndarray:
    """Whether some pair of edges overlaps, in every frame."""
    (contact,) = (t for t in scene.terms if isinstance(t, Contact))
    topology = scene.rod.topology
    ends = topology.edge_nodes[contact.pairs.array].reshape(-1, 4)
    nearest = jax.jit(lambda x: jnp.min(distance(x[:, ends]), axis=1))
    return np.asarray(nearest(derjax.positions(topology, q))) < 2 * float(contact.radius)


HYDRODYNAMICS = ["rft", pytest.param("rss", marks=pytest.mark.slow)]


@pytest.fixture(scope="module", params=HYDRODYNAMICS)
def case(request):
    """A scene and the forward derivatives of its head's position, (3, 5)."""
    file = nested(request.param)
    jacobian, (scene, q, report) = forward_mode(file, AT)
    report.raise_if_failed()
    start, *frames = touching(scene, q)
    assert not start
    assert sum(frames) > len(frames) // 2
    return file, np.asarray(jacobian)


def test_derivatives_in_contact_equal_central_differences(case):
    """Of every coordinate with respect to every parameter, friction and stiffness included."""
    file, jacobian = case
    for i, (name, h) in enumerate(zip(NAMES, DIFFERENCES, strict=True)):
        ends = [np.asarray(position(file, AT.at[i].add(s * h))[0]) for s in (1, -1)]
        slope = (ends[0] - ends[1]) / (2 * h)
        size = np.abs(slope).max()
        assert size > 1e-8, name  # m: far above round-off
        # Of the derivative as a vector: its sideways component is a thousand times smaller.
        np.testing.assert_allclose(jacobian[:, i], slope, rtol=0, atol=1e-4 * size, err_msg=name)


@pytest.mark.slow
def test_reverse_equals_forward_in_contact(case):
    file, jacobian = case
    gradient, report = reverse_mode(file, AT)
    assert report.ok
    np.testing.assert_allclose(gradient, np.asarray(WEIGHTS) @ jacobian, rtol=1e-8)
