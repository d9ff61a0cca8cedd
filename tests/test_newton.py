"""Newton's method: where there is no minimum, and in which units residuals are measured."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from derjax.core.pytree import Indices
from derjax.core.status import Status
from derjax.solve.contributions import Elements
from derjax.solve.dense import factor_or_with
from derjax.solve.local import Autodiff
from derjax.solve.newton import NewtonInfo, NewtonSettings, equilibrium
from derjax.solve.potential import assemble

PAIR = Indices(np.array([[0, 1]]))


def double_well(x: jax.Array, data: jax.Array) -> jax.Array:
    """Two wells at x = -1 and 1 along the first coordinate, tilted by a force; a spring."""
    tilt, size = data
    u, v = x[0], x[1] / size
    return u**4 / 4 - u**2 / 2 - tilt * u + 2.0 * (v - u) ** 2


def found(
    guess: jax.Array, tilt: jax.Array | float, size: float = 1.0
) -> tuple[jax.Array, jax.Array]:
    """Where the equilibrium is, and its status and iterations."""
    data = jnp.array([[tilt, size]])
    potential = assemble([Elements(PAIR, Autodiff(double_well), data)])
    settings = NewtonSettings(jnp.asarray(1e-10), jnp.array([1.0, 1.0 / size]))
    q, info = equilibrium(potential, guess * jnp.array([1.0, size]), settings, None)
    return q, jnp.stack([info.status, info.iterations])


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("start", [0.0, 1.0])
def test_an_unstable_equilibrium_has_its_own_derivative(derivative, start):
    """By the implicit function theorem, at the top between the wells and at the bottom of one.

    There the spring is not stretched and (3 u^2 - 1) du = d tilt.
    """
    guess = jnp.full(2, start)
    slope, status = jax.jit(derivative(lambda tilt: found(guess, tilt)[0])), found(guess, 0.0)[1]
    assert status[0] == Status.OK
    np.testing.assert_allclose(slope(0.0), np.full(2, 1.0 / (3.0 * start**2 - 1.0)), rtol=1e-12)


def test_the_way_down_from_a_hill_does_not_depend_on_units():
    """From where the matrix is indefinite, with the second coordinate in m, mm and km."""
    guess = jnp.array([0.1, 0.05])
    ways = [found(guess, 0.0, size) for size in (1.0, 1e3, 1e-3)]
    for size, (q, count) in zip((1.0, 1e3, 1e-3), ways, strict=True):
        np.testing.assert_allclose(q, [1.0, size], rtol=1e-9)
        assert count[0] == Status.OK
        assert count[1] == ways[0][1][1]


def pulled_from_both_sides(x: jax.Array, data: jax.Array) -> jax.Array:
    """Stiff springs that hold the first coordinate, and soft ones at the second."""
    stiff = 0.5 * data * ((x[0] - 1.0) ** 2 + (x[0] + 1.0) ** 2)
    return stiff + 0.5 * (x[1] - x[0]) ** 2 + 0.25 * x[1] ** 4


def test_rounding_of_a_large_potential_stops_no_step():
    """What the soft springs gain is less than what rounding makes of the energy of the others."""
    potential = assemble([Elements(PAIR, Autodiff(pulled_from_both_sides), jnp.array([1e9]))])
    settings = NewtonSettings(jnp.asarray(1e-12), jnp.ones(2))
    starts = jnp.stack([jnp.geomspace(1e-12, 1e-9, 64), jnp.geomspace(1e-5, 1e-4, 64)], axis=1)
    q, info = jax.vmap(lambda start: equilibrium(potential, start, settings, None))(starts)
    np.testing.assert_array_equal(info.status, Status.OK)
    np.testing.assert_allclose(q, 0.0, atol=1e-11)


def test_a_solution_of_which_no_derivative_is_taken_may_be_off_by_what_is_negligible():
    """And no more; one of which a derivative is taken is exact, as the derivative is."""

    def solved(negligible: float, tilt: jax.Array | float = 0.0) -> tuple[jax.Array, NewtonInfo]:
        potential = assemble([Elements(PAIR, Autodiff(double_well), jnp.array([[tilt, 1.0]]))])
        settings = NewtonSettings(jnp.asarray(1e-12), jnp.ones(2), negligible=negligible)
        return equilibrium(potential, jnp.array([1.2, 0.9]), settings, None)

    exact, how = solved(0.0)
    slope = jax.jacfwd(lambda tilt: solved(0.0, tilt)[0])(0.0)
    for negligible in (1e-4, 1e-6, 1e-8):
        rough, quickly = solved(negligible)
        assert quickly.status == Status.OK
        assert how.residual < 1e-12 < quickly.residual < 1e-4
        assert quickly.iterations < how.iterations
        assert 0.0 < jnp.abs(rough - exact).max() < negligible

        def of_tilt(tilt, negligible=negligible):
            return solved(negligible, tilt)[0]

        same, along = jax.jvp(of_tilt, (0.0,), (1.0,))
        np.testing.assert_array_equal(same, exact)
        np.testing.assert_array_equal(along, slope)
        np.testing.assert_allclose(jax.jacrev(of_tilt)(0.0), slope, rtol=1e-14)


def test_what_another_matrix_holds_needs_nothing_else():
    """Contact's stiffness is added to a matrix that is not stable without it, before a ridge is."""
    unit, b = jnp.ones(3), jnp.array([1.0, 2.0, 3.0])
    soft = jnp.array([[-1.0, 0.5, 0.0], [0.5, 2.0, 0.0], [0.0, 0.0, 1.0]])
    stiffness = jnp.diag(jnp.array([5.0, 0.0, 0.0]))
    found, alone = factor_or_with(soft, unit, lambda: stiffness)
    assert not alone
    np.testing.assert_allclose((soft + stiffness) @ found.solve(b), b, rtol=1e-13)
    found, alone = factor_or_with(soft + stiffness, unit, lambda: stiffness)
    assert alone
    np.testing.assert_allclose((soft + stiffness) @ found.solve(b), b, rtol=1e-13)
    found, alone = factor_or_with(soft, unit, lambda: 0.01 * stiffness)
    assert not alone
    assert found.solve(b) @ b > 0.0
