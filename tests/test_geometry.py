"""Vectors and rotations: identities to round-off, and derivatives where they are delicate."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import finite_difference_jvp, rotation

from derjax.rods.vectors import any_normal, cross, dot, norm, parallel_transport, signed_angle, unit

ROUND_OFF = 1e-14


def random_units(rng: np.random.Generator, count: int) -> np.ndarray:
    vectors = rng.standard_normal((count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@jax.jit
def transport_matrix(start, end):
    return jax.vmap(lambda u: parallel_transport(u, start, end), out_axes=1)(jnp.eye(3))


def test_products_and_norm_are_those_of_numpy(rng):
    a, b = rng.standard_normal((2, 50, 3))
    np.testing.assert_allclose(dot(a, b), np.sum(a * b, axis=1), rtol=0, atol=ROUND_OFF)
    np.testing.assert_allclose(cross(a, b), np.cross(a, b), rtol=0, atol=ROUND_OFF)
    np.testing.assert_allclose(norm(a), np.linalg.norm(a, axis=1), rtol=ROUND_OFF)
    np.testing.assert_allclose(norm(unit(a)), 1.0, rtol=ROUND_OFF)


def test_norm_of_the_zero_vector_has_zero_derivatives():
    assert norm(jnp.zeros(3)) == 0.0
    np.testing.assert_array_equal(jax.grad(norm)(jnp.zeros(3)), 0.0)
    np.testing.assert_array_equal(jax.jit(jax.hessian(norm))(jnp.zeros(3)), 0.0)
    # one zero vector must not spoil its neighbours in a batch
    batch = jnp.array([[0.0, 0.0, 0.0], [3.0, 0.0, 4.0]])
    gradient = jax.grad(lambda a: jnp.sum(norm(a)))(batch)
    np.testing.assert_allclose(gradient, [[0, 0, 0], [0.6, 0, 0.8]], atol=ROUND_OFF)


def test_any_normal_is_a_unit_normal(rng):
    t = np.concatenate([random_units(rng, 200), np.eye(3), -np.eye(3)])
    normal = any_normal(jnp.asarray(t))
    np.testing.assert_allclose(dot(normal, t), 0.0, atol=ROUND_OFF)
    np.testing.assert_allclose(norm(normal), 1.0, atol=ROUND_OFF)


def test_parallel_transport_is_a_rotation_from_start_to_end(rng):
    for start, end in zip(random_units(rng, 30), random_units(rng, 30), strict=True):
        matrix = transport_matrix(start, end)
        # 1 / (1 + c) magnifies rounding for nearly opposite vectors
        tolerance = ROUND_OFF * 4 / (1 + start @ end)
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=tolerance)
        np.testing.assert_allclose(jnp.linalg.det(matrix), 1.0, atol=tolerance)
        np.testing.assert_allclose(matrix @ start, end, atol=tolerance)


def test_parallel_transport_is_the_smallest_rotation(rng):
    """It turns about start x end, which therefore stays where it is."""
    for start, end in zip(random_units(rng, 10), random_units(rng, 10), strict=True):
        axis = np.cross(start, end)
        tolerance = ROUND_OFF * 4 / (1 + start @ end)
        np.testing.assert_allclose(parallel_transport(axis, start, end), axis, atol=tolerance)


def test_parallel_transport_does_nothing_where_the_tangent_does_not_turn(rng):
    t, u = random_units(rng, 2)
    np.testing.assert_allclose(parallel_transport(u, t, t), u, atol=ROUND_OFF)


@pytest.mark.parametrize("turn", [0.0, 1e-9, 1e-3, 1.0, 3.0])
def test_transport_has_exact_derivatives_also_where_nothing_turns(rng, turn):
    start, u, along = rng.standard_normal((3, 3))
    start = unit(start)
    end = rotation(any_normal(start), turn) @ start

    def carried(v):
        return parallel_transport(u, start, unit(v))

    exact = jax.jvp(carried, (end,), (along,))[1]
    assert jnp.isfinite(jax.jit(jax.jacfwd(jax.jacrev(carried)))(end)).all()
    differences = finite_difference_jvp(jax.jit(carried), end, jnp.asarray(along), 1e-3)
    # near a half turn derivatives grow like 1 / (1 + c)
    size = 1 / (1 + np.cos(turn))
    np.testing.assert_allclose(exact, differences, atol=1e-10 * (1 + size**5))


@pytest.mark.parametrize("angle", [-3.1, -np.pi / 2, -1e-8, 0.0, 1e-8, 0.3, 2.0, np.pi])
def test_signed_angle_is_the_angle_turned(rng, angle):
    for axis in random_units(rng, 5):
        u = any_normal(jnp.asarray(axis))
        v = rotation(axis, angle) @ u
        found = float(signed_angle(u, v, jnp.asarray(axis)))
        # +pi and -pi are the same turn
        assert abs(np.angle(np.exp(1j * (found - angle)))) < ROUND_OFF
        assert np.isfinite(jax.grad(signed_angle)(u, v, jnp.asarray(axis))).all()


def test_signed_angle_changes_sign_with_the_order_and_with_the_axis(rng):
    axis = random_units(rng, 1)[0]
    u = any_normal(jnp.asarray(axis))
    v = rotation(axis, 0.7) @ u
    np.testing.assert_allclose(signed_angle(v, u, axis), -0.7, atol=ROUND_OFF)
    np.testing.assert_allclose(signed_angle(u, v, -axis), -0.7, atol=ROUND_OFF)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.4, 3.0])
def test_signed_angle_has_unit_derivative_with_the_angle_turned(angle):
    axis = jnp.array([0.0, 0.0, 1.0])
    u = jnp.array([1.0, 0.0, 0.0])

    def found(a):
        return signed_angle(u, jnp.array([jnp.cos(a), jnp.sin(a), 0.0]), axis)

    assert jax.grad(found)(angle) == pytest.approx(1.0, abs=ROUND_OFF)
    assert jax.grad(jax.grad(found))(angle) == pytest.approx(0.0, abs=ROUND_OFF)
