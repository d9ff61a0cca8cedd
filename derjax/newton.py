"""Where the gradient of a potential vanishes, and how that point moves with the potential.

`equilibrium` is a globalised Newton iteration in a `lax.while_loop`. It is differentiated by
the implicit function theorem, not through its iterations: with F(q, p) = 0,

    dq = -(dF/dq)^-1 dF/dp dp,

one linear solve with the Newton matrix at the solution. The rule is written once, in forward
mode with a transposable solve, which gives reverse mode and higher orders as well.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float, Int

from .linear import Factor, factor
from .potential import Dofs, Potential
from .pytree import pytree, replace, static
from .status import Status

_SEARCHING = -1

CLOSE = 1e5
"""Tolerances; with less than that left the residual alone tells whether a step is good."""


CHORDS = 8
"""Steps that one may still have to take with a matrix that is out of date: more of them, at the
rate at which the residual falls, cost more than a new matrix."""


@pytree
class NewtonSettings:
    """When to stop.

    Attributes:
        tolerance: the largest scaled residual of a solution, unless round-off is larger.
        force_scale: (d,) N and N m, what the residual is measured in.
        max_iterations: Newton steps.
        max_halvings: of a Newton step, in the line search.
    """

    tolerance: Float[Array, ""]
    force_scale: Dofs
    max_iterations: int = static(default=40)
    max_halvings: int = static(default=20)


@pytree
class NewtonInfo:
    """What happened.

    Attributes:
        status: how it ended, a `Status`.
        iterations: steps of Newton's method, with new matrices and old.
        factorings: matrices that were factored.
        residual: the largest scaled residual left.
    """

    status: Int[Array, ""]
    iterations: Int[Array, ""]
    factorings: Int[Array, ""]
    residual: Float[Array, ""]


def worse(first: NewtonInfo, second: NewtonInfo) -> NewtonInfo:
    """What happened in two solves, of which one follows on the other."""
    good = first.status == Status.OK
    return NewtonInfo(
        status=jnp.where(good, second.status, first.status),
        iterations=first.iterations + second.iterations,
        factorings=first.factorings + second.factorings,
        residual=jnp.where(good, jnp.maximum(first.residual, second.residual), first.residual),
    )


@pytree
class _Point:
    """What is known where the iteration has come to."""

    q: Dofs
    value: Array
    gradient: Dofs
    residual: Array


@pytree
class _Search:
    """A point, the direction in which to go from there, and the part of it that is tried next.

    The Newton matrix is `fresh` if it is that of the point, and `outdated` if the next step
    should not be taken with it.
    """

    point: _Point
    direction: Dofs
    length: Array
    tolerance: Array
    iterations: Array
    factorings: Array
    fresh: Array
    outdated: Array
    status: Array


def _insert(q: Dofs, values: Array | float, free: tuple[int, ...]) -> Dofs:
    """`q` with `values` at the free degrees of freedom."""
    return q.at[np.array(free)].set(values, unique_indices=True)


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
    shortest = 0.5**settings.max_halvings

    def scaled(force):
        return jnp.max((jnp.abs(force) / settings.force_scale)[chosen])

    def along(matrix: Factor, gradient: Dofs) -> Dofs:
        step = -matrix.solve(gradient[chosen])
        return step if free is None else _insert(jnp.zeros_like(gradient), step, free)

    def reach(q: Dofs, direction: Dofs) -> Array:
        return potential.reach(q, direction) if potential.guards else jnp.ones(())

    # The potential, its gradient and its Hessian each stand at one place in the program: they
    # are what compiling costs. A loop within a loop, and not a choice within one, as matrices
    # that are handed on from one iteration to the next would be copied.
    def renew(now: _Search) -> _Search:
        q = now.point.q
        stiffness = potential.hessian(q)
        # No residual can be smaller than what rounding the coordinates alone makes of it.
        rounding = 4.0 * jnp.finfo(q.dtype).eps * scaled(jnp.diagonal(stiffness) * q)
        matrix = factor(stiffness[chosen][:, chosen], symmetric)
        direction = along(matrix, now.point.gradient)
        start = replace(
            now,
            direction=direction,
            length=reach(q, direction),
            tolerance=jnp.maximum(settings.tolerance, rounding),
            factorings=now.factorings + 1,
            fresh=jnp.array(True),
            outdated=jnp.array(False),
        )
        return lax.while_loop(
            lambda now: (now.status == _SEARCHING) & ~now.outdated, partial(advance, matrix), start
        )

    def advance(matrix: Factor, now: _Search) -> _Search:
        q = now.point.q + now.length * now.direction
        if symmetric:
            value, gradient = potential.value_and_gradient(q)
        else:
            value, gradient = now.point.value, potential.gradient(q)
        residual, before = scaled(gradient), now.point.residual
        accepted = residual <= (1.0 - 1e-4 * now.length) * before
        if symmetric:
            slope = now.direction @ now.point.gradient
            # Far from the solution a smaller residual alone will not do: where rods touch,
            # iterations that trade the one for the other may go round in circles. Close to it
            # the potential says nothing any more, for rounding.
            close = before <= CLOSE * now.tolerance
            accepted &= close | (value <= now.point.value)
            accepted |= (slope < 0) & (value <= now.point.value + 1e-4 * now.length * slope)
        finite = jnp.isfinite(residual)
        accepted &= finite
        solved = accepted & (residual <= now.tolerance)
        count = now.iterations + 1

        # The steps that are left if each lowers the residual by as much as this one did. What
        # the first evaluation, at the guess, has before it says nothing: it needs no new matrix.
        left = jnp.log(now.tolerance / residual) / jnp.log(residual / before)
        lasting = (now.length == 1.0) & (residual < before) & (left <= CHORDS)
        first = now.iterations < 0
        outdated = ~solved & jnp.where(accepted, ~first & ~lasting, ~now.fresh)
        # Near the solution rounding may leave no step that lowers the residual any further.
        stalled = before <= 100.0 * now.tolerance
        status = jnp.select(
            [
                solved,
                accepted & (count > settings.max_iterations),
                accepted | outdated | (now.length > shortest),
                stalled,
                finite,
            ],
            [Status.OK, Status.MAX_ITERATIONS, _SEARCHING, Status.OK, Status.LINE_SEARCH],
            Status.NON_FINITE,
        )
        direction = along(matrix, gradient)
        here = replace(
            now,
            point=_Point(q, value, gradient, residual),
            direction=direction,
            length=reach(q, direction),
            iterations=count,
            fresh=first,
        )
        shorter = replace(now, length=0.5 * now.length)
        new = jax.tree.map(lambda a, b: jnp.where(accepted, a, b), here, shorter)
        return replace(new, status=status.astype(jnp.int32), outdated=outdated)

    infinite = jnp.array(jnp.inf, guess.dtype)
    start = _Search(
        point=_Point(guess, infinite, jnp.zeros_like(guess), infinite),
        direction=jnp.zeros_like(guess),
        length=jnp.ones(()),
        tolerance=settings.tolerance,
        iterations=jnp.array(-1, jnp.int32),  # the first evaluation is not a Newton step
        factorings=jnp.zeros((), jnp.int32),
        fresh=jnp.array(True),
        outdated=jnp.array(True),
        status=jnp.array(_SEARCHING, jnp.int32),
    )
    end = lax.while_loop(lambda now: now.status == _SEARCHING, renew, start)
    iterations = jnp.maximum(end.iterations, 0)
    return end.point.q, NewtonInfo(end.status, iterations, end.factorings, end.point.residual)


@equilibrium.defjvp
def _equilibrium_jvp(free, primals, tangents):
    potential, guess, settings = primals
    d_potential, d_guess, _ = tangents
    q, info = equilibrium(potential, guess, settings, free)
    # What a rollout keeps for reverse mode, so that Newton's iterations need not be replayed.
    q = checkpoint_name(q, "state")
    info = replace(info, status=checkpoint_name(info.status, "state"))
    chosen = slice(None) if free is None else np.array(free)
    # Clamped degrees of freedom follow the guess; the others follow from F = 0.
    clamped = jnp.zeros_like(q) if free is None else _insert(d_guess, 0.0, free)
    _, d_gradient = jax.jvp(lambda p, y: p.gradient(y), (potential, q), (d_potential, clamped))
    matrix = potential.hessian(lax.stop_gradient(q))[chosen][:, chosen]
    solver = factor(lax.stop_gradient(matrix), potential.symmetric)

    def stiffness(x):
        """The Newton matrix times x: never computed, but what higher derivatives go through."""
        full = x if free is None else _insert(jnp.zeros_like(q), x, free)
        return jax.jvp(potential.gradient, (q,), (full,))[1][chosen]

    step = lax.custom_linear_solve(
        stiffness,
        -d_gradient[chosen],
        solve=lambda _, b: solver.solve(b),
        transpose_solve=lambda _, b: solver.solve_transposed(b),
        symmetric=False,
    )
    dq = step if free is None else _insert(clamped, step, free)
    none: Any = np.zeros((), jax.dtypes.float0)  # the tangent of an integer
    return (q, info), (dq, NewtonInfo(none, none, none, jnp.zeros_like(info.residual)))
