"""Derivatives through rollouts: forward = reverse = finite differences, to second order."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import derjax
from derjax.integrate.schemes.euler import euler
from derjax.scenes.file import SceneFile

NAMES = ("C_t", "C_r", "viscosity", "youngs_modulus", "pitch", "helix_radius")
N_FRAMES, STEPS = 10, 20

SCENE = SceneFile.model_validate(
    {"robot": {"edge_length": 0.03}, "motor": {"rpm": 100.0}, "time": {"step": 0.01, "end": 2.0}}
)


def objective(relative: jax.Array) -> tuple[jax.Array, derjax.RolloutStats]:
    """A mixture of the head's coordinates (m) and angle after 200 steps.

    `relative` are the parameters in units of their values in the scene.
    """
    values = {n: SCENE.parameters[n] * relative[i] for i, n in enumerate(NAMES)}
    scene = derjax.build(SCENE, values)
    state = scene.start
    states, report = derjax.roll_frames(scene, state, N_FRAMES, STEPS)
    angle = derjax.angles(scene.rod.topology, states.q)[-1, 0]
    return states.q[-1, :3] @ jnp.array([1.0, 0.5, 0.25]) + 1e-3 * angle, report


@pytest.fixture(scope="module")
def forward():
    gradient, report = jax.jit(jax.jacfwd(objective, has_aux=True))(jnp.ones(len(NAMES)))
    assert report.ok
    return np.asarray(gradient)


def test_reverse_equals_forward(forward):
    reverse, report = jax.jit(jax.grad(objective, has_aux=True))(jnp.ones(len(NAMES)))
    assert report.ok
    np.testing.assert_allclose(reverse, forward, rtol=1e-8)


def test_gradients_equal_central_differences(forward):
    compiled = jax.jit(objective)
    for i, name in enumerate(NAMES):
        h = 1e-4
        ends = [float(compiled(jnp.ones(len(NAMES)).at[i].add(s * h))[0]) for s in (1, -1)]
        slope = (ends[0] - ends[1]) / (2 * h)
        assert slope == pytest.approx(forward[i], rel=1e-5), name


def test_viscosity_and_modulus_only_set_the_time_scale(forward):
    # Without inertia only their ratio would count. With it, both together change the swimming
    # a little: the difference is a measure of the inertia of the head, and is not zero.
    viscosity, modulus = forward[2], forward[3]
    assert abs(viscosity + modulus) < 0.1 * abs(viscosity)
    assert viscosity + modulus != 0.0


def spring(weights: jax.Array) -> jax.Array:
    """Tip position (m) of a short rod after three viscous steps under `weights` times gravity."""
    from derjax.solve.newton import NewtonSettings
    from derjax.terms import Gravity, ResistiveDrag, Stretch

    topology = derjax.chain(4, filaments=((0, 1, 2, 3),), fixed_dofs=(0, 1, 2, 9, 10, 11))
    nodes = jnp.array([[0.0, 0, 0], [0.01, 0, 0.001], [0.02, 0, -0.002], [0.03, 0.001, 0]])
    rod, state = derjax.at_rest(topology, nodes)
    terms = (
        Stretch(jnp.full(3, 1.0 * weights[0])),
        ResistiveDrag(jnp.array(5.0), 10.0 * weights[1]),
        Gravity(jnp.full(4, 0.01), jnp.array([0.5, 0.2, -1.0])),
    )
    settings = NewtonSettings(jnp.array(1e-12), jnp.ones(topology.n_dofs))
    scene = derjax.Scene(rod, terms, None, settings, jnp.array(0.05), euler)
    states, _ = derjax.roll_frames(scene, state, 1, 3)
    return jnp.sum(states.q[-1] ** 2)


@pytest.mark.slow
def test_second_derivatives_equal_differences_of_gradients():
    at = jnp.array([1.0, 1.0])
    hessian = jax.jit(jax.hessian(spring))(at)
    gradient = jax.jit(jax.grad(spring))
    h = 1e-4
    columns = [(gradient(at.at[i].add(h)) - gradient(at.at[i].add(-h))) / (2 * h) for i in range(2)]
    np.testing.assert_allclose(hessian, jnp.stack(columns, axis=1), rtol=1e-6, equal_nan=False)
    assert np.abs(hessian).min() > 0
