"""Steps that are taken again and again, with forces corrected in between."""

import jax.numpy as jnp
from jax import lax

from .newton import NewtonInfo
from .pytree import replace
from .rod import State
from .status import Status
from .step import Scene, advance
from .terms.spillmann_teschner import SpillmannTeschner
from .terms.term import Interval


def corrected(scene: Scene, state: State) -> tuple[State, NewtonInfo]:
    """A step of a scene that has the term `SpillmannTeschner`.

    It ends when nothing overlaps, or after the term's number of tries; the overlap that is
    left then is not an error. Differentiable in forward mode only.
    """
    place = next(k for k, t in enumerate(scene.terms) if isinstance(t, SpillmannTeschner))
    contact = scene.terms[place]
    assert isinstance(contact, SpillmannTeschner)
    interval = Interval(scene.step_length, state.motor_angle)

    def attempt(force):
        terms = list(scene.terms)
        terms[place] = replace(contact, force=force)
        new, info = advance(replace(scene, terms=tuple(terms)), state)
        correction, overlaps = contact.correction(scene.rod, new.q, interval)
        return force + correction, overlaps & (info.status == Status.OK), new, info

    def wanted(carry):
        count, (_, overlaps, _, _) = carry
        return overlaps & (count < contact.tries)

    def again(carry):
        count, (force, _, _, info) = carry
        following = attempt(force)
        iterations = info.iterations + following[3].iterations
        return count + 1, (*following[:3], replace(following[3], iterations=iterations))

    first = attempt(contact.force)
    _, (_, _, new, info) = lax.while_loop(wanted, again, (jnp.ones((), jnp.int32), first))
    return new, info
