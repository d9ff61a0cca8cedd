"""Large robots in blocks: the same physics as with one dense matrix, in linear memory."""

from collections.abc import Callable
from functools import partial
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import finite_difference_jvp, perturbed, share, stage_from

from derjax import Scene, SceneFile, State, build, march_frames, positions, roll_frames
from derjax.core.pytree import Indices, replace
from derjax.core.status import Status
from derjax.integrate.frames import new_stats
from derjax.integrate.step import predict
from derjax.solve.blocks import Layout
from derjax.solve.contributions import Mobility
from derjax.solve.potential import assemble
from derjax.solve.saddle import SaddlePointSystem, no_drag
from derjax.terms import StokesletSegments
from derjax.terms.contact import neighbours as neighbourhood
from derjax.terms.fluid.block_stokeslets import BlockStokeslets, block_mobility
from derjax.terms.fluid.stokeslets import mobility
from derjax.terms.term import contributions

BLOCK = 4
ROBOTS: dict[str, dict[str, Any]] = {
    "single_flagellum": {"edge_length": 13e-3},
    "two_flagella": {"kind": "two_flagella", "edge_length": 18e-3},
    "branched": {"kind": "branched", "n_flagella": 3, "edge_length": 18e-3},
    "clamped": {"kind": "clamped", "n_flagella": 2, "edge_length": 16e-3},
}
every_robot = pytest.mark.parametrize("name", ROBOTS)
# What the others add to a clamp, a head within a rod, the tests of matrices have as well.
a_clamp_at_least = pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name == "clamped" else pytest.mark.slow) for name in ROBOTS],
)


def both(name: str, **tables: Any) -> tuple[Scene, Scene, State]:
    """A small robot solved for with one matrix and in blocks of few nodes, and its start."""
    tables = {"time": {"step": 0.02, "end": 0.2}, "contact": {"method": "none"}} | tables
    file = SceneFile.model_validate({"robot": ROBOTS[name], **tables})
    scene = build(file)
    state = scene.start
    return scene, in_blocks(scene), state


def in_blocks(scene: Scene) -> Scene:
    layout = Layout(scene.rod.topology, BLOCK)
    terms = [
        BlockStokeslets(t.viscosity, t.regularization, layout, t.end_nodes)
        if isinstance(t, StokesletSegments)
        else t
        for t in scene.terms
    ]
    return replace(scene, terms=tuple(terms), layout=layout)


def saddle_of(scene: Scene, state: State) -> SaddlePointSystem:
    """The equations of a step of implicit Euler from a state."""
    h, topology = scene.step_length, scene.rod.topology
    assert scene.layout is not None
    prediction = predict(scene, state, h, h)
    parts = contributions(scene.terms, scene.rod, state, stage_from(state, h), prediction)
    drag = next((c for c in parts if isinstance(c, Mobility)), None)
    free = np.ones(topology.n_dofs)
    free[list(topology.fixed_dofs)] = 0.0
    return SaddlePointSystem(
        potential=assemble([c for c in parts if c is not drag]),
        drag=drag or no_drag(scene.layout),
        layout=scene.layout,
        held=state.q,
        free=jnp.asarray(free),
        scale=scene.newton.force_scale,
    )


@every_robot
def test_every_degree_of_freedom_stands_in_one_place(name):
    _, scene, _ = both(name)
    layout = scene.layout
    assert layout is not None
    d = layout.topology.n_dofs
    inside = layout.dofs[layout.dofs < d]
    assert sorted([*inside, *layout.border]) == list(range(d))
    q = jnp.arange(1.0, d + 1.0)
    np.testing.assert_array_equal(layout.scatter(layout.gather(q), q[layout.border]), q)


@every_robot
def test_rods_couple_neighbours_only_so_that_the_factor_is_exact(name, rng):
    """Without the fluid: elasticity, the head and inertia are all in the pattern."""
    _, scene, rest = both(name, fluid={"hydrodynamics": "rft"})
    state = perturbed(scene.rod, rest, rng, 1e-3)
    free = np.ones(state.q.size)
    free[list(scene.rod.topology.fixed_dofs)] = 0.0

    @jax.jit
    def there_and_back(x: jax.Array) -> jax.Array:
        saddle = saddle_of(scene, state)
        z = saddle.start(state.q)
        factor, _ = saddle.linearise(z, jnp.abs(z), saddle.scales, None, exact=True)
        return factor.near.solve(factor.matrices @ x + factor.diagonal * x)

    x = free * rng.standard_normal(state.q.size)
    moves = free > 0
    np.testing.assert_allclose(there_and_back(jnp.asarray(x))[moves], x[moves], atol=1e-6)


@every_robot
def test_the_mobility_is_that_of_the_whole_robot(name, rng):
    """Close to the dense one, and exactly symmetric."""
    dense, scene, state = both(name)
    (drag,) = (t for t in scene.terms if isinstance(t, BlockStokeslets))
    (segments,) = (t for t in dense.terms if isinstance(t, StokesletSegments))
    x = positions(scene.rod.topology, state.q)
    paths = tuple(x[np.array(p)] for p in segments.solved)

    @jax.jit
    def products(f: jax.Array, g: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        law = share(drag, scene.rod, state, scene.step_length).law
        a = mobility(paths, drag.viscosity, drag.regularization, drag.end_nodes)
        inverse = jnp.linalg.inv(a)
        return law.mv(f), law.mv(g), jnp.linalg.solve(0.5 * (inverse + inverse.T), f)

    size = sum(3 * len(p) for p in paths)
    f, g = rng.standard_normal((2, size))
    af, ag, exact = (np.asarray(v) for v in products(f, g))
    assert f @ ag == pytest.approx(g @ af, rel=1e-12)
    assert np.linalg.norm(af - exact) < 4e-3 * np.linalg.norm(exact)  # edges of 13 to 18 mm


@pytest.fixture(scope="module")
def large() -> tuple[Scene, State, BlockStokeslets]:
    """A robot most of whose blocks are far from each other, and its drag."""
    file = SceneFile.model_validate(
        {"robot": {"kind": "clamped", "n_flagella": 8}, "contact": {"method": "none"}}
    )
    scene = build(file)
    state = scene.start
    (drag,) = (t for t in scene.terms if isinstance(t, BlockStokeslets))
    return scene, state, drag


def test_the_coarse_mobility_is_symmetric_and_close(large, rng):
    """Nodes in fours are one point for what is not close."""
    scene, state, drag = large

    @jax.jit
    def products(f: jax.Array, g: jax.Array) -> tuple[jax.Array, ...]:
        law = share(drag, scene.rod, state, scene.step_length).law
        return law.mv(f), law.coarse.mv(f), law.coarse.mv(g)

    uniform = np.tile([1.0, -0.5, 0.3], scene.rod.topology.n_nodes)
    noise = 0.3 * rng.standard_normal((2, uniform.size))
    f, g = uniform + noise
    exact, af, ag = (np.asarray(v) for v in products(f, g))
    assert f @ ag == pytest.approx(g @ af, rel=1e-12)
    assert 0.0 < np.linalg.norm(af - exact) < 0.02 * np.linalg.norm(exact)


def test_the_far_field_does_not_lose_digits_far_from_the_origin(large, rng):
    """Its sums are made of squares of coordinates."""
    scene, state, drag = large
    x = positions(scene.rod.topology, state.q)

    @jax.jit
    def velocity(x: jax.Array, f: jax.Array) -> jax.Array:
        return block_mobility(drag, x).mv(f)

    f = rng.standard_normal(3 * scene.rod.topology.n_nodes)
    here, there = velocity(x, f), velocity(x + 1e3, f)
    np.testing.assert_allclose(there, here, atol=1e-9 * np.abs(here).max())


@a_clamp_at_least
def test_linear_systems_are_solved_both_ways(name, rng):
    _, scene, rest = both(name)
    state = perturbed(scene.rod, rest, rng, 1e-3)

    @jax.jit
    def check(state: State, c: jax.Array) -> tuple[jax.Array, jax.Array]:
        saddle = saddle_of(scene, state)
        z = saddle.start(state.q)
        factor, _ = saddle.linearise(z, jnp.abs(z), saddle.scales, None, exact=True)
        _, product = jax.jvp(saddle.gradient, (z,), (factor.solve(c),))
        _, transpose = jax.vjp(saddle.gradient, z)
        (transposed,) = transpose(factor.solve_transposed(c))
        return product, transposed

    size = state.q.size + sum(3 * len(p) for p in scene.rod.topology.filaments)
    c = jnp.asarray(rng.standard_normal(size))
    scales = np.concatenate([scene.newton.force_scale, np.full(size - state.q.size, 1.0)])
    for found in check(state, c * scales):
        np.testing.assert_allclose(found / scales, c, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_short_steps_are_solved_as_well_as_rounding_permits(large):
    """Resistance over the length of a step makes forces of what rounding does to positions."""
    scene, state, _ = large
    step = jax.jit(scene.scheme)(scene, state, jnp.asarray(1e-7))
    assert int(step.info.status) == Status.OK
    assert int(step.info.iterations) < 6


run = jax.jit(march_frames, static_argnums=(2, 3))


@a_clamp_at_least
def test_runs_agree_with_those_of_one_dense_matrix(name):
    dense, scene, state = both(name)
    (expected, _), (found, report) = (run(s, state, 1, 8, new_stats()) for s in (dense, scene))
    report.raise_if_failed()
    n = 3 * scene.rod.topology.n_nodes
    moved = np.abs(expected.q[0] - state.q)[:n].max()
    assert np.abs(found.q - expected.q)[0, :n].max() < 5e-3 * moved


@pytest.mark.slow
def test_without_stokeslets_blocks_and_matrix_agree_to_the_tolerance():
    """Resistive drag, a scene with contacts: nothing is left out."""
    tables = {"fluid": {"hydrodynamics": "rft"}, "contact": {"method": "smooth"}}
    dense, scene, state = both("clamped", **tables)
    (expected, _), (found, report) = (run(s, state, 1, 8, new_stats()) for s in (dense, scene))
    report.raise_if_failed()
    np.testing.assert_allclose(found.q, expected.q, atol=1e-8)


def end_in_blocks(name: str) -> Callable[[jax.Array], jax.Array]:
    """Where a short run ends, by its viscosity, rate of the motor and radius of the helix."""
    tables = {"time": {"step": 0.02, "end": 0.2}, "contact": {"method": "none"}}
    tables["solver"] = {"tolerance": 1e-12}
    file = SceneFile.model_validate({"robot": ROBOTS[name], **tables})

    def end(p: jax.Array) -> jax.Array:
        viscosity, rpm, radius = p * jnp.array([1.0, 60.0, 6.4e-3])
        numbers = {"viscosity": viscosity, "rpm": rpm, "helix_radius": radius}
        scene = build(file, numbers)
        states, _ = roll_frames(in_blocks(scene), scene.start, 1, 3)
        return 1e3 * states.q[-1]

    return end


AT, ALONG = jnp.ones(3), jnp.array([0.3, -0.5, 0.2])


@pytest.mark.slow
def test_forward_derivatives_of_runs_in_blocks():
    """Those of differences; the rate of the motor moves held degrees of freedom."""
    end = end_in_blocks("clamped")
    both = jax.jit(lambda p: jax.jvp(end, (p,), (ALONG,)))  # one program for all values
    difference = finite_difference_jvp(lambda p: both(p)[0], AT, ALONG, 1e-3)
    error = np.linalg.norm(both(AT)[1] - difference)
    assert error < 1e-6 * np.linalg.norm(difference)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["single_flagellum", "clamped"])
def test_reverse_derivatives_of_runs_in_blocks(name):
    """Likewise; that systems with a head are solved both ways is tested above."""
    end = end_in_blocks(name)

    def weighted(p: jax.Array) -> jax.Array:
        q = end(p)
        return jnp.cos(jnp.arange(q.size)) @ q

    both = jax.jit(jax.value_and_grad(weighted))
    difference = finite_difference_jvp(lambda p: both(p)[0], AT, ALONG, 1e-3)
    assert float(both(AT)[1] @ ALONG) == pytest.approx(float(difference), rel=1e-6)


@pytest.mark.slow
def test_memory_grows_with_the_number_of_nodes_and_no_faster():
    """The memory that one compiled step asks for, from 4 to 16 flagella of 28 nodes."""
    sizes = []
    for n_flagella in (4, 16):
        file = SceneFile.model_validate(
            {
                "robot": {"kind": "clamped", "n_flagella": n_flagella},
                "time": {"step": 0.02, "end": 0.2},
                "solver": {"method": "blocks"},
                "contact": {"method": "none"},
            }
        )
        scene = build(file)
        step = jax.jit(scene.scheme).lower(scene, scene.start, scene.step_length)
        compiled = step.compile()
        sizes.append(compiled.memory_analysis().temp_size_in_bytes)
    assert np.log(sizes[1] / sizes[0]) / np.log(4) < 1.2


def test_groups_of_edges_find_what_all_pairs_find(rng, monkeypatch):
    """Random rods, in a list that is long enough and in one that is not, and also with all but
    those looked at whose spheres are close."""
    _, scene, rest = both("branched")
    topology = scene.rod.topology
    first, second = np.triu_indices(topology.n_edges, 2)
    pairs = Indices(np.stack([first, second], axis=1))
    starts = [perturbed(scene.rod, rest, rng, size) for size in (0.3, 1.0)]
    lists: list[list[set[tuple[int, ...]]]] = []
    for many, several in product((10**9, 0), repeat=2):
        monkeypatch.setattr(neighbourhood, "MANY", many)
        monkeypatch.setattr(neighbourhood, "SEVERAL", several)

        @partial(jax.jit, static_argnums=1)
        def closest(x: jax.Array, capacity: int) -> tuple[jax.Array, jax.Array]:
            reach, still = jnp.array(0.02), jnp.zeros_like(x)
            return neighbourhood.closest(topology, x, still, pairs, reach, reach, capacity)

        lists.append([])
        for state in starts:
            x = positions(topology, state.q)
            edges, found = closest(x, 400)
            assert 0 < found <= 400
            lists[-1].append({tuple(e) for e in np.asarray(edges)[: int(found)].tolist()})
            assert closest(x, 3)[1] > 3
    assert lists == 4 * lists[:1]


def test_large_robots_are_solved_for_in_blocks_unless_told_otherwise():
    robot = {"kind": "clamped", "n_flagella": 8}
    tables = {"robot": robot, "contact": {"method": "none"}}
    assert build(SceneFile.model_validate(tables)).layout is not None
    dense = {**tables, "solver": {"method": "dense"}}
    assert build(SceneFile.model_validate(dense)).layout is None
    assert build(SceneFile()).layout is None
    with pytest.raises(ValueError, match=r"\[solver\] method"):
        SceneFile.model_validate(
            {"solver": {"method": "blocks"}, "fluid": {"drag_matrix": "collocation"}}
        )
    # 160 nodes, so close that blocks of them have no positive drag.
    assert build(SceneFile.model_validate({"robot": {"edge_length": 8e-4}})).layout is None
