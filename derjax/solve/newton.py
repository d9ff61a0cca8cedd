"""Where the gradient of a potential vanishes, and how that point moves with the potential.

`equilibrium` is a globalised Newton iteration in a `lax.while_loop`. It is differentiated by
the implicit function theorem, not through its iterations: with F(q, p) = 0,

    dq = -(dF/dq)^-1 dF/dp dp,

one linear solve with the Newton matrix at the solution. The rule is written once, in forward
mode with a transposable solve, which gives reverse mode and higher orders as well.
"""

from functools import partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, Int

from ..core.pytree import jvp_nonzero, pytree, replace, static
from ..core.status import Status
from .contributions import Dofs

_SEARCHING = -1

CLOSE = 1e5
"""Tolerances; with less than that left the residual alone tells whether a step is good."""

ROUGH = 1e-4
"""The largest scaled residual of a solution that need not be exact."""

SIMILAR = 1e-10
"""Of a potential: a smaller part of it may be rounding."""


@pytree
class NewtonSettings:
    """When to stop.

    Attributes:
        tolerance: the largest scaled residual of a solution, unless round-off is larger.
        force_scale: (d,) N and N m, what the residual is measured in; or one number for all.
        size: (d,) m and rad, of numbers that are rounded, if larger than the unknowns themselves:
            angles are made of others, of about half a turn, that may add up to nothing.
        negligible: (d,) m and rad, by how much a solution may be off of which no derivative is
            taken, if its residual is small as well; or one number for all.
        max_iterations: Newton steps.
        max_halvings: of a Newton step, in the line search.
    """

    tolerance: Float[Array, ""] = 1e-9  # pyright: ignore[reportAssignmentType]
    force_scale: Dofs = 1.0  # pyright: ignore[reportAssignmentType]
    size: Dofs | float = 0.0
    negligible: Dofs | float = 0.0
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
    """A point, and the part of the way from there that is tried next.

    Residuals are measured in `unit`; `noise_floor` is what rounding leaves of the largest, in
    units of forces. The Newton matrix `is_current` if it is that of the point, and it
    `needs_refactor` if the next step should not be taken with it.
    """

    point: _Point
    part: Array
    unit: Dofs
    noise_floor: Array
    iterations: Array
    factorings: Array
    is_current: Array
    needs_refactor: Array
    status: Array


def _spread(settings: NewtonSettings, q: Dofs) -> NewtonSettings:
    """With a scale of every degree of freedom."""
    return replace(settings, force_scale=jnp.broadcast_to(settings.force_scale, q.shape))


def _missing(direction: Dofs, rate: Array) -> Dofs:
    """How far it still is to the solution after a step in that direction, of iterations that lower
    the residual at some rate."""
    return jnp.where(rate < 0.5, jnp.abs(direction) * rate / (1.0 - rate), jnp.inf)


def _insert(q: Dofs, values: Array | float, free: tuple[int, ...]) -> Dofs:
    """`q` with `values` at the free degrees of freedom."""
    return q.at[np.array(free)].set(values, unique_indices=True)


class Equations(Protocol):
    """What is to be solved: a `Potential`, or a `SaddlePointSystem`.

    Attributes:
        symmetric: whether a potential is to be minimised: then there are `value_and_gradient` and
            `slope`.
        max_chord_steps: steps that one may still have to take with a matrix that is out of date.
        guards: what must hold on the way.
    """

    symmetric: Any
    max_chord_steps: int
    guards: Any

    def gradient(self, q: Dofs) -> Dofs: ...

    def max_step(self, q: Dofs, direction: Dofs) -> Array: ...

    def direction(self, matrix: Any, q: Dofs, gradient: Dofs, free: Any) -> Dofs: ...

    def linearise(
        self, q: Dofs, sizes: Dofs, unit: Dofs, free: tuple[int, ...] | None, exact: bool
    ) -> tuple[Any, Dofs]: ...


@partial(jax.custom_jvp, nondiff_argnums=(3,))
def equilibrium(
    potential: Any, guess: Dofs, settings: NewtonSettings, free: tuple[int, ...] | None
) -> tuple[Dofs, NewtonInfo]:
    """The point near `guess` where the gradient of `potential` vanishes.

    Args:
        potential: `Equations`; a potential is made a minimum where it is symmetric.
        guess: (d,) start. Degrees of freedom that are not free keep its values.
        settings: tolerances. Where derivatives are taken, nothing is `negligible`.
        free: degrees of freedom to solve for; None for all.

    Returns:
        The solution and how it was reached. On failure the status says so and the best
        iterate is returned; nothing is raised in compiled code.
    """
    settings = _spread(settings, guess)
    symmetric = potential.symmetric
    chosen = slice(None) if free is None else np.array(free)
    shortest = 0.5**settings.max_halvings
    negligible = jnp.broadcast_to(settings.negligible, guess.shape)[chosen]

    def scaled(force: Dofs, unit: Dofs) -> Array:
        return jnp.max((jnp.abs(force) / unit)[chosen])

    def along(matrix: Any, q: Dofs, gradient: Dofs) -> Dofs:
        step = potential.direction(matrix, q, gradient, chosen)
        return step if free is None else _insert(jnp.zeros_like(gradient), step, free)

    # The potential, its gradient, its Hessian and a solution with it each stand at one place in the
    # program: they are what compiling costs. A loop within a loop, and not a choice within one, as
    # matrices that are handed on from one iteration to the next would be copied.
    def renew(now: _Search) -> _Search:
        q = now.point.q
        sizes = jnp.maximum(jnp.abs(q), settings.size)
        matrix, rounded = potential.linearise(q, sizes, settings.force_scale, free, exact=False)
        # No residual can be smaller than what rounding the coordinates alone makes of it. That is
        # so for every equation by itself: the inertia of a head that is heavy for a short step
        # says nothing about the twist of a thin rod.
        rounding = 4.0 * jnp.finfo(q.dtype).eps * rounded
        unit = jnp.maximum(settings.force_scale, rounding / settings.tolerance)
        before = now.point.residual
        residual = jnp.where(jnp.isinf(before), before, scaled(now.point.gradient, unit))
        start = replace(
            now,
            point=replace(now.point, residual=residual),
            unit=unit,
            noise_floor=jnp.maximum(settings.tolerance, scaled(rounding, settings.force_scale)),
            part=jnp.ones(()),
            factorings=now.factorings + 1,
            is_current=jnp.array(True),
            needs_refactor=jnp.array(False),
        )
        return lax.while_loop(
            lambda now: (now.status == _SEARCHING) & ~now.needs_refactor,
            partial(advance, matrix),
            start,
        )

    def advance(matrix: Any, now: _Search) -> _Search:
        direction = along(matrix, now.point.q, now.point.gradient)
        length = now.part
        if potential.guards:
            length = length * potential.max_step(now.point.q, direction)
        q = now.point.q + length * direction
        if symmetric:
            value, gradient = potential.value_and_gradient(q)
        else:
            value, gradient = now.point.value, potential.gradient(q)
        residual, before = scaled(gradient, now.unit), now.point.residual
        accepted = residual <= (1.0 - 1e-4 * length) * before
        if symmetric:
            slope = potential.slope(now.point.gradient, direction)
            # Far from the solution a smaller residual alone will not do: where rods touch,
            # iterations that trade the one for the other may go round in circles. Close to it
            # the potential says nothing any more, for rounding.
            close = before <= CLOSE * now.noise_floor
            # Before that, differences of the potential may be nothing but rounding of the much
            # larger energies that it is made of, and its slopes at both ends tell more of it
            # (Hager & Zhang, SIAM J. Optim. 16, 170, 2005).
            similar = value <= now.point.value + SIMILAR * jnp.abs(now.point.value)
            falling = slope + potential.slope(gradient, direction) <= 0.0
            accepted &= close | (value <= now.point.value) | (similar & falling)
            accepted |= (slope < 0) & (value <= now.point.value + 1e-4 * length * slope)
        finite = jnp.isfinite(residual)
        accepted &= finite
        count, first, rate = now.iterations + 1, now.iterations < 0, residual / before
        # The first evaluation, at the guess, is no step, and tells nothing of what is missing.
        left = jnp.where(first, jnp.inf, _missing(length * direction, rate))[chosen]
        enough = (length == 1.0) & (residual <= ROUGH) & jnp.all(left <= negligible)
        solved = accepted & (enough | (residual <= settings.tolerance))

        # The steps that are left if each lowers the residual by as much as this one did. What
        # the first evaluation has before it says nothing: it needs no new matrix.
        to_come = jnp.log(settings.tolerance / residual) / jnp.log(rate)
        lasting = (length == 1.0) & (residual < before) & (to_come <= potential.max_chord_steps)
        needs_refactor = ~solved & jnp.where(accepted, ~first & ~lasting, ~now.is_current)
        # Near the solution rounding may leave no step that lowers the residual any further.
        stalled = before <= 100.0 * settings.tolerance
        status = jnp.select(
            [
                solved | (accepted & stalled & (count > settings.max_iterations)),
                accepted & (count > settings.max_iterations),
                accepted | needs_refactor | (now.part > shortest),
                stalled,
                finite,
            ],
            [Status.OK, Status.MAX_ITERATIONS, _SEARCHING, Status.OK, Status.LINE_SEARCH],
            Status.NON_FINITE,
        )
        here = replace(
            now,
            point=_Point(q, value, gradient, residual),
            part=jnp.ones(()),
            iterations=count,
            is_current=first,
        )
        shorter = replace(now, part=0.5 * now.part)
        new = jax.tree.map(lambda a, b: jnp.where(accepted, a, b), here, shorter)
        return replace(new, status=status.astype(jnp.int32), needs_refactor=needs_refactor)

    infinite = jnp.array(jnp.inf, guess.dtype)
    start = _Search(
        point=_Point(guess, infinite, jnp.zeros_like(guess), infinite),
        part=jnp.ones(()),
        unit=settings.force_scale,
        noise_floor=settings.tolerance,
        iterations=jnp.array(-1, jnp.int32),  # the first evaluation is not a Newton step
        factorings=jnp.zeros((), jnp.int32),
        is_current=jnp.array(True),
        needs_refactor=jnp.array(True),
        status=jnp.array(_SEARCHING, jnp.int32),
    )
    end = lax.while_loop(lambda now: now.status == _SEARCHING, renew, start)
    iterations = jnp.maximum(end.iterations, 0)
    last = end.point
    left = scaled(last.gradient, settings.force_scale)
    residual = jnp.where(jnp.isinf(last.residual), last.residual, left)
    return last.q, NewtonInfo(end.status, iterations, end.factorings, residual)


@partial(equilibrium.defjvp, symbolic_zeros=True)
def _equilibrium_jvp(free, primals, tangents):
    potential, guess, settings = primals
    settings = replace(_spread(settings, guess), negligible=0.0)
    d_potential, d_guess, _ = tangents
    q, info = equilibrium(potential, guess, settings, free)
    # What a rollout keeps for reverse mode, so that Newton's iterations need not be replayed.
    q = checkpoint_name(q, "state")
    info = replace(info, status=checkpoint_name(info.status, "state"))
    chosen = slice(None) if free is None else np.array(free)
    # Clamped degrees of freedom follow the guess; the others follow from F = 0.
    clamped = jnp.zeros_like(q)
    if free is None:
        _, d_gradient = jvp_nonzero(lambda p: p.gradient(q), (potential,), (d_potential,))
    else:
        if not isinstance(d_guess, SymbolicZero):
            clamped = _insert(d_guess, 0.0, free)
        _, d_gradient = jvp_nonzero(
            lambda p, y: p.gradient(y), (potential, q), (d_potential, clamped)
        )
    still, here, unit = lax.stop_gradient((potential, q, settings.force_scale))
    solver, _ = still.linearise(here, jnp.abs(here), unit, free, exact=True)

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
