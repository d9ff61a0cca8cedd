"""What a scene does not name is not in the compiled program, and numbers are not part of it.

The program is the jaxpr: what JAX has traced and would compile. Nothing here is compiled, but for
one small program that counts compilations.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import pytest
from helpers import advance

from derjax import Scene, SceneFile, State, build, roll_frames
from derjax.core.pytree import replace
from derjax.terms import (
    Bend,
    Contact,
    Friction,
    Gravity,
    HeadDrag,
    Inertia,
    ResistiveDrag,
    SpinDrag,
    StokesletSegments,
    Stretch,
    Twist,
)

EDGE = 0.03
"""Four edges make the flagellum: the smallest robot there is."""

LEAST: dict[str, Any] = {
    "robot": {"edge_length": EDGE},
    "fluid": {"hydrodynamics": "none"},
    "head": {"drag": "none"},
    "time": {"inertia": False},
}
"""An elastic rod and its motor, and nothing else."""

SCENES: dict[str, dict[str, Any]] = {
    "least": {},
    "head": {"head": {"drag": "stokes"}},
    "inertia": {"time": {"inertia": True}},
    "gravity": {"gravity": {}},
    "rft": {"fluid": {"hydrodynamics": "rft"}},
    "spin": {"fluid": {"hydrodynamics": "rft", "spin_drag": True}},
    "rss": {"fluid": {"hydrodynamics": "rss"}},
    "collocation": {"fluid": {"hydrodynamics": "rss", "drag_matrix": "collocation"}},
}
"""What each scene has more than the least."""

ELASTIC = (Stretch, Bend, Twist)
TERMS: dict[str, tuple[type, ...]] = {
    "least": ELASTIC,
    "head": (*ELASTIC, HeadDrag),
    "inertia": (*ELASTIC, Inertia),
    "gravity": (*ELASTIC, Gravity),
    "rft": (*ELASTIC, ResistiveDrag),
    "spin": (*ELASTIC, ResistiveDrag, SpinDrag),
    "rss": (*ELASTIC, StokesletSegments),
    "collocation": (*ELASTIC, StokesletSegments),
}


def example(name: str, **numbers: float) -> tuple[Scene, State]:
    """A small scene, with other numbers for some of its parameters."""
    scene = build(SceneFile.model_validate(LEAST | SCENES[name]), numbers)
    return scene, scene.start


def equations(jaxpr: Any) -> Iterator[Any]:
    """All equations of a jaxpr, those of inner jaxprs too."""

    def is_jaxpr(x: Any) -> bool:
        return hasattr(x, "eqns") or hasattr(x, "jaxpr")

    for equation in jaxpr.eqns:
        yield equation
        for value in jax.tree.leaves(list(equation.params.values()), is_leaf=is_jaxpr):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                yield from equations(inner)


def program(function: Callable[..., Any], *arguments: Any) -> list[Any]:
    """The equations of what would be compiled."""
    return list(equations(jax.make_jaxpr(function)(*arguments).jaxpr))


def primitives(found: list[Any]) -> Counter[str]:
    """How often each primitive operation occurs."""
    return Counter(equation.primitive.name for equation in found)


def shapes(found: list[Any]) -> set[tuple[int, ...]]:
    """The shapes of everything that is computed."""
    return {tuple(v.aval.shape) for e in found for v in e.outvars if hasattr(v.aval, "shape")}


def loops(found: list[Any]) -> dict[str, int]:
    """How many while loops there are of each kind.

    Newton's iteration makes a matrix and has loops within: shifting the matrix until it has a
    Cholesky factor, and the steps that are taken with the factor.
    """
    bodies = [
        primitives(list(equations(e.params["body_jaxpr"].jaxpr)))
        for e in found
        if e.primitive.name == "while"
    ]
    newton = sum(body["while"] > 0 for body in bodies)
    shift = sum(body["cholesky"] > 0 and not body["while"] for body in bodies)
    return {"newton": newton, "shift": shift, "steps": len(bodies) - newton - shift}


@pytest.fixture(scope="module")
def steps() -> dict[str, list[Any]]:
    """The program of one step of every scene."""
    return {name: program(advance, *example(name)) for name in SCENES}


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_has_the_terms_that_it_names(name):
    scene, _ = example(name)
    assert {type(term) for term in scene.terms} == set(TERMS[name])


@pytest.mark.parametrize("name", ["head", "inertia", "gravity", "rft", "rss"])
def test_every_term_makes_the_program_longer(steps, name):
    assert len(steps[name]) > len(steps["least"])


def text(**tables: Any) -> str:
    """The program of one step of a scene, as text."""
    scene = build(SceneFile.model_validate(LEAST | tables))
    state = scene.start
    return str(jax.make_jaxpr(advance)(scene, state))


def test_contact_and_friction_are_absent_to_the_last_instruction():
    alone, none = {"robot": LEAST["robot"]}, {"contact": {"method": "none"}}
    several = {"robot": {**LEAST["robot"], "kind": "two_flagella"}}
    assert text(**alone) == text(**alone, **none)
    assert "cumsum" not in text(**several, **none)
    assert "cumsum" in text(**several)  # the search for neighbours
    assert text(**several) == text(**several, friction={"coefficient": 0.0})
    assert text(**several) != text(**several, friction={"coefficient": 0.1})


def test_contact_and_friction_are_terms_of_robots_with_several_flagella():
    several = {"robot": {**LEAST["robot"], "kind": "two_flagella"}, "friction": {}}
    scene = build(SceneFile.model_validate(LEAST | several))
    assert {type(term) for term in scene.terms} == {*ELASTIC, Contact, Friction}


@pytest.mark.parametrize("name", ["least", "head", "inertia", "gravity", "rft"])
def test_without_stokeslets_there_is_no_flow_problem(steps, name):
    """No moments of segments, nothing to invert, no array of the pairs of nodes."""
    topology = example(name)[0].rod.topology
    n = len(topology.filaments[0])
    found = primitives(steps[name])
    assert not {"atanh", "lu"} & found.keys()
    pairs = {(3 * n, 3 * n), (n, 3, n, 3), (3, 3, n, n - 1), (3, 3, n, n)}
    assert not pairs & shapes(steps[name])


@pytest.mark.parametrize("name", ["rss", "collocation"])
def test_with_stokeslets_there_is_one_flow_problem(steps, name):
    """The drag matrix is made once in a step, not once in every Newton iteration."""
    scene, _ = example(name)
    (drag,) = (term for term in scene.terms if isinstance(term, StokesletSegments))
    m = 3 * len(drag.nodes)
    found = primitives(steps[name])
    assert found["atanh"] == 1
    assert found["lu"] == 1 + (not drag.symmetric)  # the inverse; and Newton's own
    assert (m, m) in shapes(steps[name])
    (newton,) = (
        e
        for e in steps[name]
        if e.primitive.name == "while"
        and "while" in primitives(list(equations(e.params["body_jaxpr"].jaxpr)))
    )
    assert "atanh" not in primitives(list(equations(newton.params["body_jaxpr"].jaxpr)))


@pytest.mark.parametrize("name", ["inertia", "gravity"])
def test_mass_and_weight_bring_nothing_but_arithmetic(steps, name):
    """Only a few elementwise operations more, on arrays that were there before."""
    more = primitives(steps[name]) - primitives(steps["least"])
    assert not {"while", "cond", "scan", "lu", "cholesky", "triangular_solve"} & more.keys()
    assert sum(more.values()) < 60


def test_resistive_drag_is_local(steps):
    """It brings more elements, and no solver."""
    more = primitives(steps["rft"]) - primitives(steps["least"])
    assert not {"while", "lu", "cholesky", "triangular_solve", "atanh"} & more.keys()


@pytest.mark.parametrize("name", SCENES)
def test_newton_stands_once_in_the_program_of_a_step(steps, name):
    symmetric = name != "collocation"
    assert loops(steps[name]) == {"newton": 1, "shift": int(symmetric), "steps": 1}
    assert primitives(steps[name])["cholesky"] == 2 * symmetric


def total(scene: Scene, state: State) -> jax.Array:
    """A number that depends on every step of a run."""
    states, _ = roll_frames(scene, state, 2, 3)
    return jnp.sum(states.q**2)


def test_a_run_has_the_program_of_one_step(steps):
    assert loops(program(total, *example("least"))) == loops(steps["least"])


def test_forward_mode_does_not_iterate_again():
    """The tangent of a step is a solve with one more factor, not another Newton iteration.

    Nothing is added to the matrix of that factor.
    """
    scene, state = example("least")
    pushed = program(lambda scene: jax.jvp(lambda s: total(s, state), (scene,), (scene,)), scene)
    assert loops(pushed) == {"newton": 1, "shift": 1, "steps": 1}
    plain = program(total, scene, state)
    assert primitives(pushed)["cholesky"] == primitives(plain)["cholesky"] + 1


def test_reverse_mode_runs_newton_twice_and_no_more():
    """Once forward, and once when a segment is run again to have its states."""
    scene, state = example("least")
    assert loops(program(jax.grad(total), scene, state))["newton"] == 2


def test_numbers_are_not_part_of_the_program_and_terms_are():
    """Other numbers use the compiled program; another term, or another choice, makes a new one."""
    traced = []

    @jax.jit
    def potential_energy(scene: Scene, state: State) -> jax.Array:
        traced.append(len(scene.terms))
        return state.q @ jnp.ones_like(state.q) + sum(
            jnp.sum(leaf) for leaf in jax.tree.leaves(scene)
        )

    scene, state = example("rss")
    potential_energy(scene, state)
    for numbers in ({"C_t": 2.0}, {"viscosity": 0.5, "youngs_modulus": 2e6}, {"rpm": 10.0}):
        potential_energy(*example("rss", **numbers))
    potential_energy(replace(scene, step_length=0.5 * scene.step_length), state)
    assert potential_energy._cache_size() == len(traced) == 1  # pyright: ignore
    potential_energy(*example("head"))
    assert potential_energy._cache_size() == len(traced) == 2  # pyright: ignore
    potential_energy(*example("collocation"))
    assert potential_energy._cache_size() == len(traced) == 3  # pyright: ignore


def test_the_same_scene_has_the_same_structure_whenever_it_is_built():
    """Or else two fits of one scene would compile twice."""
    first, second = (jax.tree.structure(example("rss", C_t=c)) for c in (1.0, 2.0))
    assert first == second
    assert hash(first) == hash(second)
    assert first != jax.tree.structure(example("collocation"))
