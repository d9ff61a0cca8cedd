"""Steps that are taken again and again, with forces corrected in between."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ...core.pytree import replace
from ...core.status import Status
from ...rods.rod import State
from ...terms.contact.spillmann_teschner import SpillmannTeschner
from ..step import Scene, Step
from .euler import euler


def contact_corrected_euler(scene: Scene, state: State, length: Array) -> Step:
    """A step of implicit Euler of a scene that has the term `SpillmannTeschner`.

    It ends when nothing overlaps, or after the term's number of tries; the overlap that is
    left then is not an error. Differentiable in forward mode only.

    Raises:
        ValueError: the scene has no such term, or several.
    """
    found = [(k, t) for k, t in enumerate(scene.terms) if isinstance(t, SpillmannTeschner)]
    if len(found) != 1:
        raise ValueError(
            f"this scheme corrects the forces of one term SpillmannTeschner, the scene has "
            f"{len(found)}"
        )
    ((place, contact),) = found

    def attempt(force):
        terms = list(scene.terms)
        terms[place] = replace(contact, force=force)
        step = euler(replace(scene, terms=tuple(terms)), state, length)
        correction, overlaps = contact.correction(scene.rod, step.state.q, length)
        return force + correction, overlaps & (step.info.status == Status.OK), step

    def wanted(carry):
        count, (_, overlaps, _) = carry
        return overlaps & (count < contact.tries)

    def again(carry):
        count, (force, _, before) = carry
        force, overlaps, step = attempt(force)
        info = replace(
            step.info,
            iterations=before.info.iterations + step.info.iterations,
            factorings=before.info.factorings + step.info.factorings,
        )
        step = replace(step, info=info)
        return count + 1, (force, overlaps, step)

    first = attempt(contact.force)
    return lax.while_loop(wanted, again, (jnp.ones((), jnp.int32), first))[1][2]
