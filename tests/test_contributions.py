"""Every form of contribution in every solver and scheme, with its derivatives; and refusals.

One robot has a term of each form, with a strength of its own. The derivative of a step along
each strength must be that of differences, whoever solves for the step.
"""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import finite_difference_jvp

from derjax import SceneFile, build
from derjax.core.pytree import Indices, pytree, replace
from derjax.core.status import Status
from derjax.integrate.step import Scene
from derjax.rods.rod import Rod, State
from derjax.solve.blocks import Layout
from derjax.solve.contributions import (
    Contribution,
    Diagonal,
    Dofs,
    Elements,
    Load,
    LocalHessians,
    Mobility,
    Pairs,
    Quadratic,
)
from derjax.solve.gmres import gmres
from derjax.solve.local import Autodiff
from derjax.terms import ExplicitDrag, SpillmannTeschner, Stage, Term
from derjax.terms.fluid.block_stokeslets import BlockStokeslets

BLOCK = 4
KINDS = ("Elements", "Pairs", "Quadratic", "Diagonal", "Load", "Chain")
SOLVERS, SCHEMES = ("dense", "blocks"), ("euler", "trbdf2")
STRENGTH = np.array([0.02, 0.03, 0.01, 0.02, 1e-4, 0.02])
"""N/m, and N of the load."""

ROBOT = {"edge_length": 0.03}
FILE = {
    "robot": ROBOT,
    "fluid": {"hydrodynamics": "none"},
    "time": {"step": 0.02, "end": 0.1},
    "solver": {"tolerance": 1e-13},
}


def stretched(local: jax.Array, stiffness: jax.Array) -> jax.Array:
    """J, of a spring without length between two nodes, that hardens."""
    squared = jnp.sum((local[:3] - local[3:]) ** 2)
    return 0.5 * stiffness * squared * (1.0 + 100.0 * squared)


@pytree
class Matrix:
    """An operator known as a matrix (N/m)."""

    a: jax.Array

    def matrix(self) -> jax.Array:
        return self.a

    def mv(self, displacement: jax.Array) -> jax.Array:
        return self.a @ displacement


@pytree
class Chain(Contribution):
    """A form that derjax does not have: `1/2 k |q - origin|^2 + k/4 q_0^4` of some nodes."""

    k: jax.Array
    origin: Dofs

    def value(self, q: Dofs) -> jax.Array:
        return 0.5 * self.k * jnp.sum((q - self.origin) ** 2) + 0.25 * self.k * q[0] ** 4

    def gradient(self, q: Dofs) -> Dofs:
        return self.k * (q - self.origin) + jnp.zeros_like(q).at[0].set(self.k * q[0] ** 3)

    def local_hessians(self, q: Dofs) -> LocalHessians:
        return ((np.array([[0]]), 3.0 * self.k * q[0] ** 2 * jnp.ones((1, 1, 1))),)

    def diagonal(self, q: Dofs) -> Dofs:
        return self.k * jnp.ones_like(q)


@pytree
class Own(Term):
    """A term with a contribution of each form, of some strengths."""

    strength: jax.Array

    def of(self, kind: str, rod: Rod, state: State) -> Contribution:
        topology, k = rod.topology, self.strength[KINDS.index(kind)]
        n = 3 * topology.n_nodes
        ends = topology.node_dofs([0, topology.n_nodes - 1]).ravel()[None]
        middle = topology.node_dofs([2, topology.n_nodes - 2]).ravel()[None]
        if kind == "Elements":
            return Elements(Indices(ends), Autodiff(stretched), k[None])
        if kind == "Pairs":
            law: Any = Autodiff(stretched)
            return Pairs(jnp.asarray(middle), jnp.array([True]), law, k[None])
        if kind == "Quadratic":
            # Every node is tied to every other, all over the robot.
            along = jnp.eye(n) + 0.2 * jnp.tile(jnp.eye(3), (n // 3, n // 3))
            return Quadratic(Indices(np.arange(n)), True, Matrix(k * along), 0.9 * state.q)
        if kind == "Diagonal":
            weight = jnp.where(jnp.arange(state.q.size) < n, k, 1e-6 * k)
            return Diagonal(weight, 1.1 * state.q)
        if kind == "Load":
            return Load(jnp.zeros_like(state.q).at[n - 2].set(k))
        return Chain(k, state.q)

    def contribution(self, rod: Rod, state: State, stage: Stage, cache: Any) -> Contribution:
        raise NotImplementedError


def own_term(kind: str, strength: jax.Array) -> Term:
    """A term with one of the contributions."""

    @pytree
    class One(Own):
        def contribution(self, rod: Rod, state: State, stage: Stage, cache: Any) -> Contribution:
            return self.of(kind, rod, state)

    return One(strength)


def scene_of(solver: str, scheme: str, terms: tuple[Term, ...] = ()) -> tuple[Scene, State]:
    """A small robot with more terms."""
    times = FILE["time"] | {"scheme": scheme}
    scene = build(SceneFile.model_validate(FILE | {"time": times}))
    state = scene.start
    layout = Layout(scene.rod.topology, BLOCK) if solver == "blocks" else None
    return replace(scene, terms=(*scene.terms, *terms), layout=layout), state


@cache
def step_of(solver: str, scheme: str) -> dict[str, np.ndarray]:
    """Where a step with all contributions ends, its status, and derivatives by strengths."""

    @jax.jit
    def run(scene: Scene, state: State, strength: jax.Array) -> tuple[jax.Array, ...]:
        def end(strength: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
            own = tuple(own_term(kind, strength) for kind in KINDS)
            acting = replace(scene, terms=(*scene.terms, *own))
            step = acting.scheme(acting, state, acting.step_length)
            return step.state.q, (step.state.q, step.info.status)

        return jax.jacfwd(end, has_aux=True)(strength)

    scene, state = scene_of(solver, scheme)
    at = jnp.asarray(STRENGTH)
    slopes, (q, status) = run(scene, state, at)
    differences = [
        finite_difference_jvp(lambda s: run(scene, state, s)[1][0], at, along, 1e-3)
        for along in jnp.diag(at)
    ]
    return {
        "q": np.asarray(q),
        "status": np.asarray(status),
        "forward": np.asarray(slopes).T * STRENGTH[:, None],
        "differences": np.array(differences),
    }


# Two stages of different lengths are the harder case.
in_both_schemes = pytest.mark.parametrize(
    "scheme", ["trbdf2", pytest.param("euler", marks=pytest.mark.slow)]
)


@in_both_schemes
@pytest.mark.parametrize("solver", [pytest.param("dense", marks=pytest.mark.slow), "blocks"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_step_has_the_derivatives_of_every_form(kind, solver, scheme):
    step, k = step_of(solver, scheme), KINDS.index(kind)
    assert step["status"] == Status.OK
    forward, difference = step["forward"][k], step["differences"][k]
    assert np.linalg.norm(difference) > 1e-7
    assert np.linalg.norm(forward - difference) < 1e-6 * np.linalg.norm(difference)


@in_both_schemes
def test_blocks_end_where_one_matrix_does(scheme):
    dense, blocks = (step_of(solver, scheme) for solver in SOLVERS)
    np.testing.assert_allclose(blocks["q"], dense["q"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(blocks["forward"], dense["forward"], rtol=1e-5, atol=1e-10)


def test_every_form_of_derjax_is_among_them():
    own = [kind for kind in Contribution.__subclasses__() if kind.__module__.startswith("derjax")]
    assert {kind.__name__ for kind in own} == set(KINDS) - {Chain.__name__}


def trace(scene: Scene, state: State) -> None:
    jax.eval_shape(lambda: scene.scheme(scene, state, scene.step_length))


@pytree
class Answer(Term):
    """A term that answers with what it is given."""

    answer: Any

    def contribution(self, rod: Rod, state: State, stage: Stage, cache: Any) -> Any:
        return self.answer


@pytest.mark.parametrize("scheme", SCHEMES)
def test_blocks_refuse_a_force_without_potential(scheme):
    odd = Quadratic(Indices([0, 1]), False, Matrix(jnp.eye(2)), jnp.zeros(1))
    scene, state = scene_of("blocks", scheme)
    odd = replace(odd, origin=state.q)
    with pytest.raises(ValueError, match=r"symmetric=False.*'dense'"):
        trace(replace(scene, terms=(*scene.terms, Answer(odd))), state)
    trace(replace(scene, terms=(*scene.terms, Answer(odd)), layout=None), state)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("answer", [None, 1.0])
def test_what_is_no_contribution_is_refused(solver, answer):
    with pytest.raises(TypeError, match="no share of a potential"):
        trace(*scene_of(solver, "euler", (Answer(answer),)))


def stokes_in_blocks(scheme: str = "euler") -> tuple[Scene, State]:
    tables = {"fluid": {"hydrodynamics": "rss"}, "solver": {"method": "blocks"}}
    times = {"step": 0.02, "end": 0.1, "scheme": scheme}
    scene = build(SceneFile.model_validate({"robot": ROBOT, **tables, "time": times}))
    return scene, scene.start


@pytest.mark.parametrize("scheme", SCHEMES)
def test_drag_of_blocks_is_refused_by_one_matrix(scheme):
    scene, state = stokes_in_blocks(scheme)
    trace(scene, state)
    with pytest.raises(ValueError, match=r"without layout.*StokesletSegments"):
        trace(replace(scene, layout=None), state)


def test_a_second_drag_of_blocks_is_refused():
    scene, state = stokes_in_blocks()
    (drag,) = (t for t in scene.terms if isinstance(t, BlockStokeslets))
    with pytest.raises(ValueError, match="2 terms have a Mobility"):
        trace(replace(scene, terms=(*scene.terms, drag)), state)


def test_blocks_of_another_layout_are_refused():
    scene, state = stokes_in_blocks()
    with pytest.raises(ValueError, match="must be one Layout"):
        trace(replace(scene, layout=Layout(scene.rod.topology, 3)), state)
    other = build(SceneFile.model_validate({"robot": {"edge_length": 0.02}}))
    with pytest.raises(ValueError, match="of another robot"):
        trace(replace(scene, terms=(), layout=Layout(other.rod.topology, 4)), state)


def test_explicit_drag_says_what_it_cannot_take():
    scene, state = stokes_in_blocks()
    terms = tuple(ExplicitDrag(t) if isinstance(t, BlockStokeslets) else t for t in scene.terms)
    with pytest.raises(ValueError, match=r"explicit drag.*'dense'"):
        trace(replace(scene, terms=terms), state)
    scene, state = scene_of("dense", "trbdf2", (ExplicitDrag(own_term("Diagonal", jnp.ones(6))),))
    with pytest.raises(ValueError, match="only for the scheme euler"):
        trace(scene, state)


def test_a_linear_system_that_is_not_solved_is_no_solution(rng):
    """Derivatives must not be those of a system that was given up."""
    a = jnp.asarray(rng.standard_normal((30, 30)))
    b = jnp.asarray(rng.standard_normal(30))
    solved = gmres(lambda x: a @ x, b, 1e-12, 30, 1e-6)
    np.testing.assert_allclose(a @ solved, b, atol=1e-8)
    assert np.isnan(gmres(lambda x: a @ x, b, 1e-12, 5, 1e-6)).all()
    assert np.isfinite(gmres(lambda x: a @ x, b, 1e-12, 5)).all()
    assert not gmres(lambda x: a @ x, 0.0 * b, 1e-12, 5).any()


def test_mobility_stands_beside_the_contributions():
    assert not issubclass(Mobility, Contribution)


@pytest.mark.parametrize("count", [0, 2])
def test_forces_of_one_term_are_corrected_try_by_try(count):
    robot = {"kind": "two_flagella", "edge_length": 0.03}
    contact = {"method": "spillmann_teschner"}
    scene = build(SceneFile.model_validate({"robot": robot, "contact": contact}))
    state = scene.start
    (found,) = (t for t in scene.terms if isinstance(t, SpillmannTeschner))
    others = tuple(t for t in scene.terms if t is not found)
    with pytest.raises(ValueError, match=f"the scene has {count}"):
        trace(replace(scene, terms=(*others, *[found] * count)), state)
