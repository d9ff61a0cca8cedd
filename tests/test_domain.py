"""What the fluid is bounded by: a wall that is added from outside, in a few lines.

The wall is a plane along which fluid slides without resistance and that it does not cross. A force
beside it makes the flow of free space and that of its mirror image, so that a robot beside it does
what it would do in free space next to a robot that does the same in the mirror.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import finite_difference_jvp
from jaxtyping import Array, Float

from benchmarks.rigid import rigid_motions, rigid_resistance
from derjax import Scene, SceneFile, build, march_frames, positions, pytree, roll_frames
from derjax.core.pytree import replace
from derjax.integrate.frames import new_stats
from derjax.solve.blocks import Layout
from derjax.terms import StokesletSegments
from derjax.terms.fluid import kernels
from derjax.terms.fluid.block_stokeslets import BlockStokeslets, block_mobility
from derjax.terms.fluid.domain import FREE_SPACE, Domain
from derjax.terms.fluid.stokeslets import flow, mobility, pull

FLIP = np.array([1.0, 1.0, -1.0])


@pytree
class SlipWall(Domain):
    """Fluid above the plane z = height (m), which it slides along."""

    height: Float[Array, ""]

    def mirrored(self, x: Float[Array, "p 3"]) -> Float[Array, "p 3"]:
        return FLIP * x + 2.0 * self.height * np.array([0.0, 0.0, 1.0])

    def boundary_point_flow(self, targets, sources, forces, regularization):
        return kernels.point_flow(targets, self.mirrored(sources), FLIP * forces, regularization)


@pytree
class ExactWall(SlipWall):
    """The same, with the flow of segments in closed form."""

    def boundary_segment_flow(self, targets, starts, ends, at_start, at_end, regularization):
        image = (self.mirrored(x) for x in (starts, ends))
        densities = FLIP * at_start, FLIP * at_end
        return kernels.segment_flow(targets, *image, *densities, regularization)


FLUID = jnp.asarray(2.0), jnp.asarray(0.05), "half"
"""Viscosity (Pa s), regularization (m) and weight of end nodes."""


matrix_of, flow_of, pull_of = (
    jax.jit(function, static_argnames="end_nodes") for function in (mobility, flow, pull)
)


@pytest.fixture
def filaments(rng) -> tuple[np.ndarray, ...]:
    """Two of them above the plane z = 0, with edges of about one metre."""
    return tuple(
        np.cumsum(rng.uniform(0.2, 0.8, (n, 3)), axis=0) + np.array([0.0, k, 0.2])
        for k, n in enumerate((4, 5))
    )


@pytest.mark.parametrize("wall", [SlipWall(0.0), ExactWall(0.0)], ids=["points", "segments"])
def test_products_with_the_mobility_are_those_of_the_matrix(filaments, rng, wall):
    """Matrix and transpose follow from the flow of the boundary, however that is given."""
    vector = rng.normal(size=(9, 3))
    matrix = matrix_of(filaments, *FLUID, wall)
    forth, back = (function(filaments, vector, *FLUID, wall) for function in (flow_of, pull_of))
    np.testing.assert_allclose(forth.ravel(), matrix @ vector.ravel(), rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(back.ravel(), matrix.T @ vector.ravel(), rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize(("gap", "error"), [(0.2, 3e-3), (0.5, 1e-4), (1.0, 1e-6)])
def test_what_the_boundary_adds_is_integrated_along_segments(rng, gap, error):
    """For a rod at some edge lengths from the wall, against the closed form."""
    nodes = np.stack([np.arange(4.0), np.zeros(4), np.full(4, gap)], axis=1)
    force = rng.normal(size=(4, 3))
    found, exact, free = (
        flow_of((nodes,), force, *FLUID, domain)
        for domain in (SlipWall(0.0), ExactWall(0.0), FREE_SPACE)
    )
    assert np.abs(found - exact).max() < error * np.abs(exact - free).max()


def test_mobility_is_symmetric_as_in_free_space(filaments):
    """Of points exactly; of segments to what collocation spoils."""
    points, wall = np.concatenate(filaments), SlipWall(0.0)
    of_points = jax.jit(jax.jacobian(lambda f: wall.point_flow(points, points, f, FLUID[1])))
    at_points = of_points(jnp.zeros((9, 3))).reshape(27, 27)
    np.testing.assert_allclose(at_points, at_points.T, atol=1e-12 * np.abs(at_points).max())

    def spoilt(domain: Domain) -> float:
        a = np.asarray(matrix_of(filaments, *FLUID, domain))
        return float(np.linalg.norm(a - a.T) / np.linalg.norm(a))

    assert spoilt(wall) < 1.05 * spoilt(FREE_SPACE)


def test_no_flow_goes_through_the_wall(filaments, rng):
    """Of points and of segments in closed form; else as well as segments are integrated."""
    on_wall = np.append(rng.uniform(-1.0, 3.0, (20, 2)), np.zeros((20, 1)), axis=1)
    nodes, forces = filaments[0], rng.normal(size=(4, 3))

    @jax.jit
    def through(domain: Domain) -> tuple[Array, ...]:
        segments = nodes[:-1], nodes[1:], forces[:-1], forces[1:]
        flows = (
            domain.point_flow(on_wall, nodes, forces, FLUID[1]),
            domain.segment_flow(on_wall, *segments, FLUID[1]),
        )
        return tuple(jnp.abs(u[:, 2]).max() / jnp.abs(u).max() for u in flows)

    assert min(through(FREE_SPACE)) > 0.1
    assert max(through(ExactWall(0.0))) < 1e-13
    by_points, by_segments = through(SlipWall(0.0))
    assert by_points < 1e-13
    assert by_segments < 1e-3


resistance = jax.jit(StokesletSegments.resistance)


def drag_of(nodes: np.ndarray, domain: Domain) -> np.ndarray:
    """Resistance (N s/m) of a rigid rod to moving along and across itself, and along z."""
    path = tuple(range(len(nodes)))
    term = StokesletSegments(*FLUID[:2], solved=(path,), dragged=path, domain=domain)
    return np.diag(rigid_resistance(nodes, resistance(term, nodes)))[:3]


def test_drag_beside_the_wall_is_that_of_a_rod_beside_its_mirror_image():
    """The image comes along where the rod slides along the wall, and holds it where it leaves."""
    nodes = np.stack([np.linspace(-2.0, 2.0, 9), np.zeros(9), np.full(9, 0.6)], axis=1)
    free, near, far = (drag_of(nodes, d) for d in (FREE_SPACE, SlipWall(0.0), SlipWall(-1e6)))
    assert (near[:2] < 0.9 * free[:2]).all()
    assert near[2] > 1.2 * free[2]
    np.testing.assert_allclose(far, free, rtol=1e-5)

    both = np.concatenate([nodes, nodes * FLIP])
    paths = tuple(range(9)), tuple(range(9, 18))
    pair = StokesletSegments(*FLUID[:2], solved=paths, dragged=tuple(range(18)))
    motion = np.array(rigid_motions(both))[:, :3]
    motion[27:, 2] *= -1.0  # the image moves as in a mirror
    of_pair = np.diag(motion.T @ resistance(pair, both) @ motion)
    np.testing.assert_allclose(drag_of(nodes, ExactWall(0.0)), of_pair / 2.0, rtol=1e-10)
    np.testing.assert_allclose(near, of_pair / 2.0, rtol=1e-5)


# Whole robots -------------------------------------------------------------------------------

FILE = SceneFile.model_validate(
    {
        "robot": {"edge_length": 13e-3},
        "time": {"step": 0.02, "end": 0.2},
        "contact": {"method": "none"},
        "solver": {"tolerance": 1e-12},
    }
)


def beside(scene: Scene, domain: Domain, in_blocks: bool = False) -> Scene:
    """The scene in a domain, solved for with one matrix or in blocks of four nodes."""
    layout = Layout(scene.rod.topology, 4) if in_blocks else None

    def moved(term: Any) -> Any:
        if not isinstance(term, StokesletSegments):
            return term
        if layout is not None:
            term = BlockStokeslets(term.viscosity, term.regularization, layout, term.end_nodes)
        return replace(term, domain=domain)

    return replace(scene, terms=tuple(moved(t) for t in scene.terms), layout=layout)


run = jax.jit(march_frames, static_argnums=(2, 3))


@pytest.mark.slow
def test_both_drags_of_segments_take_a_wall():
    """The robot moves as the same with one matrix, and not as in free space."""
    scene, wall = build(FILE), SlipWall(-0.015)
    scenes = {
        "free": scene,
        "wall": beside(scene, wall),
        "blocks": beside(scene, wall, in_blocks=True),
    }
    ends = {}
    for name, changed in scenes.items():
        states, report = run(changed, changed.start, 1, 8, new_stats())
        report.raise_if_failed()
        ends[name] = np.asarray(states.q[0, : 3 * scene.rod.topology.n_nodes])
    moved = np.abs(ends["wall"] - scene.start.q[: len(ends["wall"])]).max()
    assert np.abs(ends["blocks"] - ends["wall"]).max() < 5e-3 * moved
    assert np.abs(ends["free"] - ends["wall"]).max() > 2e-2 * moved


def check_derivatives(function: Any, *, step: float, error: float) -> None:
    """Of a vector by two numbers near one: forward, reverse and differences."""
    at, along = jnp.ones(2), jnp.array([0.05, 0.2])
    push = jax.jit(lambda p: jax.jvp(function, (p,), (along,)))
    forward = push(at)[1]
    difference = finite_difference_jvp(lambda p: push(p)[0], at, along, step)
    assert np.linalg.norm(forward - difference) < error * np.linalg.norm(difference)
    weights = jnp.cos(jnp.arange(forward.size))
    reverse = jax.jit(jax.grad(lambda p: weights @ function(p)))(at) @ along
    assert float(reverse) == pytest.approx(float(weights @ forward), rel=1e-8)


@pytest.mark.slow
def test_derivatives_of_a_run_by_the_height_of_the_wall():
    """And by the viscosity."""

    def end(p: Array) -> Array:
        scene = build(FILE, {"viscosity": p[0]})
        changed = beside(scene, SlipWall(-0.015 * p[1]))
        return 1e3 * roll_frames(changed, changed.start, 1, 3)[0].q[-1]

    check_derivatives(end, step=1e-2, error=1e-6)


def test_a_domain_without_numbers_is_not_lost():
    """It is part of the structure that a scene was built with: `replace` refuses to lose it."""
    scene = build(FILE)
    terms = [
        replace(t, domain=SlipWall(jnp.zeros(()))) if hasattr(t, "domain") else t
        for t in scene.terms
    ]
    with pytest.raises(ValueError, match="StokesletSegments"):
        replace(scene, terms=tuple(terms)).replace(C_t=4.0)


@pytest.mark.slow
def test_derivatives_of_a_mobility_in_blocks_by_the_height_of_the_wall(rng):
    """And by the size of the robot."""
    scene = build(FILE)
    x = np.asarray(positions(scene.rod.topology, scene.start.q))
    force = rng.normal(size=x.size - 3 * (len(x) - len(scene.rod.topology.filaments[0])))

    def velocity(p: Array) -> Array:
        changed = beside(scene, SlipWall(-0.015 * p[1]), in_blocks=True)
        (drag,) = (term for term in changed.terms if isinstance(term, BlockStokeslets))
        return block_mobility(drag, p[0] * x).mv(force)

    check_derivatives(velocity, step=1e-2, error=1e-6)
