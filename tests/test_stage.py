"""What terms are told of a stage: when it ends, and how the fluid flows meanwhile."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import elasticity, order, rest

from derjax import Scene, SceneFile, State, build, chain, march_frames, positions, roll_frames
from derjax.core.pytree import pytree, replace
from derjax.integrate.schemes.euler import euler
from derjax.integrate.schemes.trbdf2 import trbdf2
from derjax.rods.rod import Rod
from derjax.solve.contributions import Diagonal, Load
from derjax.solve.newton import NewtonSettings
from derjax.terms import ResistiveDrag, SpinDrag, Stage, Term

run = jax.jit(march_frames, static_argnums=(2, 3))


@pytree
class Swing(Term):
    """A force on every degree of freedom that swings in time, and drag on each: c q' = cos(w t)."""

    resistance: jax.Array
    frequency: jax.Array

    def contribution(self, rod: Rod, state: State, stage: Stage, cache: None) -> Diagonal:
        force = jnp.cos(self.frequency * stage.time)
        weight = jnp.full_like(state.q, self.resistance / stage.length)
        return Diagonal(weight, stage.origin_from(state) + force * stage.length / self.resistance)


@pytest.mark.parametrize(("scheme", "expected"), [(euler, 1.0), (trbdf2, 2.0)])
def test_loads_that_depend_on_time_act_when_a_stage_ends(scheme, expected):
    """Each scheme has its order with them: q = sin(w t) / (c w)."""
    rod, state = rest(chain(2), np.array([[0.0, 0, 0], [1.0, 0, 0]]))
    settings = NewtonSettings(jnp.array(1e-13), jnp.ones(rod.topology.n_dofs))
    c, w = jnp.array(2.0), jnp.array(1.0)
    errors, counts = [], [20, 40, 80]
    for n in counts:
        scene = Scene(rod, (Swing(c, w),), None, settings, jnp.array(1.0 / n), scheme)
        states, report = run(scene, state, 1, n)
        assert report.ok
        moved = states.q[-1] - state.q
        np.testing.assert_allclose(moved, moved[0], rtol=1e-12)
        errors.append(abs(float(moved[0] - jnp.sin(w) / (c * w))))
    assert order([1.0 / n for n in counts], errors) == pytest.approx(expected, abs=0.1)


@pytree
class LinearFlow(Term):
    """A fluid that flows with u = velocity + gradient x, wherever rods are."""

    velocity: jax.Array
    gradient: jax.Array

    def fluid_velocity(self, x: jax.Array, time: jax.Array) -> jax.Array:
        return self.velocity + self.gradient @ x

    def contribution(self, rod: Rod, state: State, stage: Stage, cache: None) -> Load:
        return Load(jnp.zeros_like(state.q))


ROBOT = {"edge_length": 0.025}
TIMES = {"step": 0.02, "end": 0.1}
SCENES: dict[str, dict[str, Any]] = {
    "resistive": {"fluid": {"hydrodynamics": "rft", "spin_drag": True}},
    "segments": {"fluid": {"hydrodynamics": "rss"}},
    "segments in blocks": {"fluid": {"hydrodynamics": "rss"}, "solver": {"method": "blocks"}},
    "explicit": {"fluid": {"hydrodynamics": "rss"}, "time": {"step": 1e-4, "scheme": "explicit"}},
    "second order": {"fluid": {"hydrodynamics": "rft"}, "time": TIMES | {"scheme": "trbdf2"}},
}


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n == "segments" else pytest.mark.slow) for n in SCENES],
)
def test_a_uniform_flow_carries_the_robot_along(name):
    """All drag is relative to the fluid: the robot swims as in fluid at rest, and drifts."""
    tables = {"robot": ROBOT, "time": TIMES | {"inertia": False}} | SCENES[name]
    tables["time"] = {"inertia": False} | tables["time"]
    scene = build(SceneFile.model_validate(tables))
    state = scene.start
    drift = jnp.array([0.01, -0.02, 0.005])
    flow = LinearFlow(drift, jnp.zeros((3, 3)))
    if name == "explicit":  # has inertia: start with the fluid
        along = jnp.tile(drift, scene.rod.topology.n_nodes)
        velocity = jnp.pad(along, (0, scene.rod.topology.n_edges))
        carried = replace(state, velocity=velocity)
    else:
        carried = state
    moving = replace(scene, terms=(*scene.terms, flow))
    if name == "resistive":  # nothing is known of a flow: else one program serves for both
        quiet = scene
    else:
        quiet = replace(scene, terms=(*scene.terms, replace(flow, velocity=jnp.zeros(3))))
    still, first = run(quiet, state, 1, 4)
    moved, second = run(moving, carried, 1, 4)
    assert first.ok
    assert second.ok
    x, y = (positions(scene.rod.topology, s.q[-1]) for s in (still, moved))
    time = float(still.time[-1])
    np.testing.assert_allclose(y - x, np.broadcast_to(time * drift, x.shape), atol=2e-8)


def stiff_rod() -> tuple[Scene, State]:
    """A stiff straight rod along y in a viscous fluid, free and without inertia."""
    n = 9
    nodes = np.zeros((n, 3))
    nodes[:, 1] = np.linspace(-0.5, 0.5, n)
    rod, state = rest(chain(n, filaments=(tuple(range(n)),)), nodes)
    drag = ResistiveDrag(jnp.array(1.0), jnp.array(2.0)), SpinDrag(jnp.array(1e-3))
    settings = NewtonSettings(jnp.array(1e-10), jnp.ones(rod.topology.n_dofs))
    terms = (*elasticity(rod, 1e5, 1e2, 1e2), *drag)
    return Scene(rod, terms, None, settings, jnp.array(0.01), trbdf2), state


def slant(scene: Scene, state: State, steps: int, roll=march_frames) -> jax.Array:
    """x over y from the middle to the end of the rod."""
    states, _ = roll(scene, state, 1, steps)
    x = positions(scene.rod.topology, states.q[-1])
    along = x[-1] - x[len(x) // 2]
    return along[0] / along[1]


@pytest.mark.slow
def test_a_slender_rod_turns_in_shear_as_jeffery_says():
    """Without thickness cot(phi) grows by the shear rate, phi being the angle with the flow."""
    scene, state = stiff_rod()

    def sheared(rate: jax.Array) -> Scene:
        gradient = jnp.zeros((3, 3)).at[0, 1].set(rate)
        return replace(scene, terms=(*scene.terms, LinearFlow(jnp.zeros(3), gradient)))

    turned = jax.jit(lambda r: jax.jvp(lambda r: slant(sheared(r), state, 100), (r,), (1.0,)))
    value, slope = turned(1.5)
    assert float(value) == pytest.approx(1.5, rel=2e-3)
    assert float(slope) == pytest.approx(1.0, rel=2e-3)
    back = jax.jit(jax.grad(lambda r: slant(sheared(r), state, 100, roll_frames)))
    assert float(back(1.5)) == pytest.approx(float(slope), rel=1e-9)
