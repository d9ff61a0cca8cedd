"""Where the gradient of a potential vanishes, and how that point moves with the potential.

`equilibrium` is a globalised Newton iteration in a `lax.while_loop`. It is differentiated by
the implicit function theorem, not through its iterations: with F(q, p) = 0,

    dq = -(dF/dq)^-1 dF/dp dp,

one linear solve with the Newton matrix at the solution. The rule is written once, in forward
mode with a transposable solve, which gives reverse mode and higher orders as well.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float, Int

from .linear import factor
from .potential import Dofs, Potential
from .pytree import pytree, static
from .status import Status


@pytree
class NewtonSettings:
    """When to stop.

    Attributes:
        tolerance: the largest scaled residual of a solution.
        force_scale: (d,) N and N m, what the residual is measured in.
        round_off: (d,) scaled residual per unit of a coordinate that rounding it causes, in
            units of the machine epsilon; the tolerance never goes below it.
        max_iterations: Newton steps.
        max_halvings: of a Newton step, in the line search.
    """

    tolerance: Float[Array, ""]
    force_scale: Dofs
    round_off: Dofs
    max_iterations: int = static(default=40)
    max_halvings: int = static(default=12)


@pytree
class NewtonInfo:
    """What happened: status code, Newton iterations, largest scaled residual left."""

    status: Int[Array, ""]
    iterations: Int[Array, ""]
    residual: Float[Array, ""]


@pytree
class _Iterate:
    q: Dofs
    value: Array
    gradient: Dofs
    residual: Array
    iterations: Array
    status: Array


@partial(jax.custom_jvp, nondiff_argnums=(3,))
def equilibrium(
    potential: Potential, guess: Dofs, settings: NewtonSettings, free: tuple[int, ...] | None
) -> tuple[Dofs, NewtonInfo]:
    """The point near `guess` where the gradient of `potential` vanishes.

    Args:
        potential: to be made stationary; a minimum where it is symmetric.
        guess: (d,) start. Degrees of freedom that are not free keep its values.
        settings: tolerances.
        free: degrees of freedom to solve for; None for all.

    Returns:
        The solution and how it was reached. On failure the status says so and the best
        iterate is returned; nothing is raised in compiled code.
    """
    symmetric = potential.symmetric
    chosen = slice(None) if free is None else np.array(free)
    epsilon = jnp.finfo(guess.dtype).eps
    floor = 16.0 * epsilon * jnp.max(settings.round_off * jnp.abs(guess))
    tolerance = jnp.maximum(settings.tolerance, floor)

    def measure(gradient):
        return jnp.max(jnp.abs((gradient / settings.force_scale)[chosen]))

    def evaluate(q):
        gradient = potential.gradient(q)
        value = potential.value(q) if symmetric else jnp.zeros(())
        return value, gradient, measure(gradient)

    def search(now, direction):
        """Halve the step until it lowers the residual or, sufficiently, the potential."""
        slope = direction @ now.gradient

        def trial(length):
            q = now.q + length * direction
            return q, *evaluate(q)

        def rejected(carry):
            length, halvings, (_, value, _, residual) = carry
            lower = residual <= (1.0 - 1e-4 * length) * now.residual
            if symmetric:
                lower |= (slope < 0) & (value <= now.value + 1e-4 * length * slope)
            return ~lower & (halvings < settings.max_halvings)

        def halve(carry):
            length, halvings, _ = carry
            return 0.5 * length, halvings + 1, trial(0.5 * length)

        one = jnp.ones(())
        return lax.while_loop(rejected, halve, (one, 0, trial(one)))[1:]

    def iterate(now: _Iterate) -> _Iterate:
        matrix = potential.hessian(now.q)[chosen][:, chosen]
        step = -factor(matrix, symmetric).solve(now.gradient[chosen])
        direction = step if free is None else jnp.zeros_like(now.q).at[chosen].set(step)
        halvings, (q, value, gradient, residual) = search(now, direction)
        status = jnp.where(halvings >= settings.max_halvings, Status.LINE_SEARCH, Status.OK)
        status = jnp.where(jnp.isfinite(residual), status, Status.NON_FINITE)
        return _Iterate(q, value, gradient, residual, now.iterations + 1, status.astype(jnp.int32))

    def unfinished(now: _Iterate):
        return (
            (now.residual > tolerance)
            & (now.status == Status.OK)
            & (now.iterations < settings.max_iterations)
        )

    zero = jnp.zeros((), jnp.int32)
    end = lax.while_loop(unfinished, iterate, _Iterate(guess, *evaluate(guess), zero, zero))
    status = jnp.where(
        (end.status == Status.OK) & (end.residual > tolerance), Status.MAX_ITERATIONS, end.status
    )
    status = jnp.where(jnp.isfinite(end.residual), status, Status.NON_FINITE)
    return end.q, NewtonInfo(status.astype(jnp.int32), end.iterations, end.residual)


@equilibrium.defjvp
def _equilibrium_jvp(free, primals, tangents):
    potential, guess, settings = primals
    d_potential, d_guess, _ = tangents
    q, info = equilibrium(potential, guess, settings, free)
    q = checkpoint_name(q, "state")
    chosen = slice(None) if free is None else np.array(free)
    # Clamped degrees of freedom follow the guess; the others follow from F = 0.
    clamped = jnp.zeros_like(q) if free is None else d_guess.at[chosen].set(0.0)
    _, d_gradient = jax.jvp(
        lambda p, y: p.gradient(y), (potential, q), (d_potential, clamped)
    )
    matrix = potential.hessian(q)[chosen][:, chosen]
    solver = factor(matrix, potential.symmetric)
    step = lax.custom_linear_solve(
        lambda x: matrix @ x,
        -d_gradient[chosen],
        solve=lambda _, b: solver.solve(b),
        transpose_solve=lambda _, b: solver.solve_transposed(b),
        symmetric=False,
    )
    dq = step if free is None else clamped.at[chosen].set(step)
    none = np.zeros((), jax.dtypes.float0)
    return (q, info), (dq, NewtonInfo(none, none, jnp.zeros_like(info.residual)))
