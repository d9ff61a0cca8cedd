"""The contact forces of published codes: explicit, corrected until nothing overlaps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import advance, rest

from derjax import Scene, State, Topology, positions
from derjax.core.pytree import Indices, replace
from derjax.core.status import Status
from derjax.integrate.schemes.contact_corrected import contact_corrected_euler
from derjax.integrate.schemes.euler import euler
from derjax.solve.newton import NewtonSettings
from derjax.terms import Gravity, Inertia, SpillmannTeschner, Stretch
from derjax.terms.contact.segments import distance

DIAMETER = 0.1
RODS = Topology(4, ((0, 1), (2, 3)), ())
"""Two free rods of one edge each."""

MASS = jnp.full(4, 0.5)


def crossed(gap: float, angle: float = 1.2, shift: float = 0.0) -> tuple[Scene, State]:
    """Two rods in vacuum, the second `gap` above the first and `shift` along it."""
    along = 0.5 * np.array([np.cos(angle), np.sin(angle), 0])
    centre = np.array([shift, 0.0, gap])
    nodes = np.array([[-0.5, 0, 0], [0.5, 0, 0], centre - along, centre + along])
    rod, state = rest(RODS, nodes)
    inertia = jnp.concatenate([jnp.repeat(MASS, 3), jnp.full(2, 1e-3)])
    pairs = Indices(np.array([[0, 1]]))
    contact = SpillmannTeschner(
        jnp.asarray(DIAMETER / 2), MASS, jnp.zeros(RODS.n_dofs), pairs, tries=200
    )
    weight = Gravity(MASS, jnp.array([0.1, 0.2, 0.3]))
    terms = (Stretch(jnp.full(2, 10.0)), Inertia(inertia), weight, contact)
    settings = NewtonSettings(jnp.asarray(1e-8), jnp.ones(RODS.n_dofs))
    return Scene(rod, terms, None, settings, jnp.asarray(0.01), contact_corrected_euler), state


def approaching(state: State, speed: float) -> State:
    velocity = state.velocity.at[jnp.array([2, 5])].set(speed).at[jnp.array([8, 11])].set(-speed)
    return replace(state, velocity=velocity)


step = jax.jit(advance)
plain = jax.jit(lambda scene, state: advance(replace(scene, scheme=euler), state))


def gap_of(state: State) -> float:
    return float(distance(positions(RODS, state.q)))


def momentum(velocity: jax.Array) -> np.ndarray:
    return np.asarray(MASS @ positions(RODS, velocity))


@pytest.mark.parametrize(
    ("gap", "speed"),
    [(0.95, 0.0), (0.5, 0.0), (1.1, 2.0)],  # overlapping a little, a lot; about to
)
@pytest.mark.parametrize("shift", [0.0, 0.3])
def test_rods_that_overlap_are_pushed_apart_within_the_step(gap, speed, shift):
    """Where mass dominates; equally and oppositely if the masses of nodes are equal."""
    scene, state = crossed(gap * DIAMETER, shift=shift)
    state = approaching(state, speed)
    without, _ = plain(replace(scene, terms=scene.terms[:3]), state)
    assert gap_of(without) < 0.96 * DIAMETER
    new, info = step(scene, state)
    assert info.status == Status.OK
    # each correction leaves half of the overlap or less, so that the last of it is round-off
    assert gap_of(new) > (1 - 1e-9) * DIAMETER
    assert gap_of(new) < 1.3 * DIAMETER
    above = positions(RODS, new.q)[:, 2]
    assert np.mean(above[2:]) > np.mean(above[:2])
    change = momentum(new.velocity) - momentum(without.velocity)
    assert np.abs(change).max() < 1e-12


def test_step_without_contact_is_that_of_a_scene_without_it():
    scene, state = crossed(1.5 * DIAMETER)
    state = approaching(state, 0.5)
    new, info = step(scene, state)
    expected, plain_info = plain(replace(scene, terms=scene.terms[:3]), state)
    assert gap_of(expected) > DIAMETER
    assert int(info.iterations) == int(plain_info.iterations)
    for found, other in zip(jax.tree.leaves(new), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(found, other, rtol=1e-14, atol=1e-14)
