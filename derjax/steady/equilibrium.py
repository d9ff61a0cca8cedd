"""Equilibria of rods that are held: shapes that do not move, buckled ones among them.

The rod is let go where the scene starts and relaxes in its fluid, by steps of implicit Euler that
grow until inertia and drag say nothing any more; Newton's method does the rest. So what is found
is where the rod would come to rest, also beyond buckling, where Newton's method alone would stay
with the straight rod or jump to some other branch.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..core.pytree import pytree, replace
from ..core.status import Status
from ..integrate.schemes.euler import euler
from ..integrate.step import Scene
from ..rods.rod import State, no_history
from .motion import held_still
from .solve import (
    ROUNDING,
    Equations,
    Found,
    Steady,
    largest,
    newton,
    solved_by,
    unknowns_of,
    unwrapped,
)

LONG, LONGER, SHORTER = 1.3, 3.0, 0.2
"""The next step is longer than this one by the least and the most; by how much after a failure."""

SLOWLY = 1.1
"""Forces may rise so much in a step that is still followed by a longer one."""

MOST_STEPS = 400
"""Before the search for an equilibrium is given up."""

SHORTEST = 1e-9
"""Steps, over the scene's length of a step, at which it is given up."""

CLOSE = 1e-4
"""Newton's method is tried when so little is left of the largest force on the way, and may move the
rod by so much of its length: else it might end on another branch."""


def equilibrium(scene: Scene, guess: Steady | None = None) -> Steady:
    """Where a rod that is held comes to rest under its loads, its motors standing still.

    Differentiable in forward and reverse mode, to any order, by the implicit function theorem.
    Whether it is stable is what `derjax.stability` says: a rod that is perfectly straight, and
    pressed along its axis, stays so, as no force bends it. Start it a little bent to find where it
    buckles to.

    Args:
        scene: with clamps, or with other degrees of freedom that are held.
        guess: the equilibrium of a scene that differs a little: Newton's method starts there, and
            stays on that branch, stable or not.

    Returns:
        With a status: `Status.TOO_SHORT` or `Status.TOO_MANY` where the rod did not come to rest.

    Raises:
        InputError: nothing is held, or the scene has more to it than the forces of its terms.
    """
    return _solved(scene, guess)


@jax.jit
def _solved(scene: Scene, guess: Steady | None) -> Steady:
    equations = still(scene)
    known = None if guess is None else unknowns_of(equations, guess)
    found = _settled(*lax.stop_gradient((scene, known)))
    return solved_by(equations, found)


def still(scene: Scene) -> Equations:
    """The equations of a scene that is held, with its motors at rest."""
    return Equations(replace(scene, motor=None), held_still(scene))


@pytree
class _Fall:
    """A rod on its way to rest.

    Attributes:
        state: where it is.
        length: s, of the next step.
        z: the free degrees of freedom of the equilibrium, if it has been found.
        size: largest scaled force that is left there.
        force: that at the state.
        worst: the largest on the way.
        count: steps so far.
    """

    state: State
    length: Array
    z: Array
    size: Array
    force: Array
    worst: Array
    count: Array


@jax.jit
def _settled(scene: Scene, guess: Array | None) -> Found:
    equations = still(scene)
    tolerance, one = scene.newton.tolerance, jnp.ones(())
    enough = ROUNDING * tolerance

    if guess is not None:
        found = newton(equations, guess, one, tolerance)
        status = jnp.where(found.size <= enough, Status.OK, Status.MAX_ITERATIONS)
        return found.z, one, status.astype(jnp.int32), found.tries, found.size

    def going(now: _Fall) -> Array:
        unfinished = (now.size > enough) & (now.count < MOST_STEPS)
        return unfinished & (now.length > SHORTEST * scene.step_length)

    def step(now: _Fall) -> _Fall:
        # From a standstill: where the rod is going is of no use for a step that is much longer.
        state = now.state
        state = replace(state, velocity=jnp.zeros_like(state.q), history=no_history(state.q))
        tried = euler(equations.scene, state, now.length)
        good = tried.info.status == Status.OK
        state = jax.tree.map(lambda a, b: jnp.where(good, a, b), tried.state, state)
        z = unwrapped(state)[equations.free]
        force = largest(equations.residual(z))
        near = good & (force < CLOSE * now.worst)
        z, size = lax.cond(near, polished, lambda z: (z, force), z)
        # As forces fall steps grow. Where the rod buckles forces rise, and steps keep up with that.
        rise = force / now.force
        change = jnp.where(rise < SLOWLY, jnp.clip(1.0 / rise, LONG, LONGER), 1.0)
        length = now.length * jnp.where(good, change, SHORTER)
        worst = jnp.maximum(now.worst, force)
        return _Fall(state, length, z, size, force, worst, now.count + 1)

    def polished(z: Array) -> tuple[Array, Array]:
        """By Newton's method, as long as that does not lead elsewhere."""
        end = newton(equations, z, one, tolerance)
        stays = jnp.max(jnp.abs(end.z - z)) < CLOSE * jnp.sum(scene.rod.rest_length)
        done = stays & (end.size <= enough)
        return jnp.where(done, end.z, z), jnp.where(done, end.size, jnp.inf)

    z = equations.start()
    size = largest(equations.residual(z))
    none = jnp.zeros((), jnp.int32)
    start = _Fall(scene.start, scene.step_length, z, size, size, size, none)
    end = lax.while_loop(going, step, start)
    status = jnp.select(
        [end.size <= enough, end.count >= MOST_STEPS],
        [Status.OK, Status.TOO_MANY],
        Status.TOO_SHORT,
    )
    return end.z, one, status.astype(jnp.int32), end.count, end.size
