"""Steady states over a parameter, each found from those before it."""

from collections.abc import Iterable, Iterator

import jax
import jax.numpy as jnp

from ..core.pytree import replace
from ..integrate.step import Scene
from .motion import RigidMotion
from .solve import Steady, steady, unwrapped


def steady_curve(scene: Scene, name: str, values: Iterable[float]) -> Iterator[Steady]:
    """Steady states of a scene at some values of a parameter, one after the other.

    Each is looked for where the two before it point to, so that a curve costs a fraction of its
    states one by one. One that is not found has a status that says so, and the next is looked for
    all the same. On the host: not for scenes that JAX traces.

    Args:
        scene: a robot that swims.
        name: of a parameter that is a single number, as "rpm".
        values: of it, in order.

    Raises:
        KeyError: a parameter that the scene does not have.
        ValueError: one with several values.
        InputError: the scene cannot swim steadily.
    """
    scene.number(name)
    values = list(values)
    return along((scene.replace(**{name: value}) for value in values), values)


def along(scenes: Iterable[Scene], values: Iterable[float]) -> Iterator[Steady]:
    """Steady states of scenes that differ in some value, in their order."""
    known: list[tuple[float, Steady]] = []
    for scene, value in zip(scenes, values, strict=True):
        state = steady(scene, _guess(known, value))
        if state.ok:
            known = [*known[-1:], (value, state)]
        yield state


def _guess(known: list[tuple[float, Steady]], value: float) -> Steady | None:
    """What the last two states say of the next; the last, if there is but one."""
    if len(known) < 2:
        return known[-1][1] if known else None
    (first, before), (second, last) = known
    if first == second:
        return last
    return _extrapolated(before, last, jnp.asarray((value - second) / (second - first)))


@jax.jit
def _extrapolated(before: Steady, last: Steady, part: jax.Array) -> Steady:
    """The last of two states, moved on by a part of how they differ."""
    q, motion = unwrapped(last.state), last.motion
    onwards = part * (q - unwrapped(before.state))
    n = q.size - last.state.turns.size
    moved = replace(last.state, q=(q + onwards).at[n:].add(-2 * jnp.pi * last.state.turns))
    ahead = RigidMotion(
        motion.velocity + part * (motion.velocity - before.motion.velocity),
        motion.rotation + part * (motion.rotation - before.motion.rotation),
    )
    return replace(last, state=moved, motion=ahead)
