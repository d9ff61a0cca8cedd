"""How one talks to derjax from Python: scenes, runs, what acts, own energies."""

import warnings
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import derjax as dj

TABLES = {
    "robot": {"edge_length": 0.025},
    "fluid": {"hydrodynamics": "rft"},
    "time": {"step": 0.02, "end": 0.2, "frame": 0.04},
}
FILE = dj.SceneFile.from_dict(TABLES)
SCENE = dj.build(FILE, {"C_t": 4.0})


@cache
def swum() -> dj.Run:
    return dj.rollout(SCENE)


def test_a_run_has_its_start_and_all_frames_of_the_file():
    run = swum()
    np.testing.assert_allclose(run.time, np.arange(6) * 0.04, atol=1e-12)
    np.testing.assert_array_equal(run.states.q[0], SCENE.start.q)
    assert run.positions.shape == (6, SCENE.rod.topology.n_nodes, 3)
    np.testing.assert_array_equal(run.head_position, run.positions[:, 0])
    np.testing.assert_array_equal(run.last.q, run.states.q[-1])
    run.raise_if_failed()
    assert run.stats.steps == 10
    assert run.summary()["v_x_m_per_s"] == pytest.approx(
        np.polyfit(run.time[3:], run.head_position[3:, 0], 1)[0], rel=1e-6
    )
    assert run.to_dataset().attrs["C_t"] == 4.0


def test_both_kinds_of_run_end_alike():
    quick = dj.rollout(SCENE, reverse_mode=False)
    np.testing.assert_allclose(quick.last.q, swum().last.q, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("times", "said"),
    [
        ({"end": 0.19}, r"end = 0.19 s: no whole number of frames of 0.04 s"),
        ({"frame": 0.03}, r"frame = 0.03 s: no whole number of steps of 0.02 s"),
    ],
)
def test_times_that_do_not_divide_one_another_are_refused(times, said):
    with pytest.raises(ValueError, match=said):
        dj.rollout(SCENE, **times)


def test_other_numbers_need_no_new_program(caplog):
    """Not even those of another file, or after `replace`."""
    swum()
    others = [
        SCENE.replace(pitch=0.05),
        SCENE.replace(pitch=0.05).replace(rpm=30.0),
        dj.build(dj.SceneFile.from_dict(TABLES | {"head": {"C_r": 0.5}})),
    ]
    with jax.log_compiles(), caplog.at_level("WARNING"):
        runs = [dj.rollout(scene) for scene in others]
    compiled = [r.message for r in caplog.records if "Compiling jit(roll_frames)" in r.message]
    assert not compiled
    ends = {float(run.last.q[0]) for run in [*runs, swum()]}
    assert len(ends) == 4


def test_replace_is_a_new_scene_of_the_file():
    """Numbers given before stay, and so do those that follow from others by default."""
    assert float(SCENE.parameters["C_t"]) == 4.0
    new = SCENE.replace(rod_radius=2e-3, pitch=0.05)
    expected = dj.build(FILE, {"C_t": 4.0, "rod_radius": 2e-3, "pitch": 0.05})
    jax.tree.map(np.testing.assert_array_equal, new, expected)
    kept = dj.build(FILE, {"regularization": 1e-3}).replace(rod_radius=2e-3)
    assert float(kept.parameters["regularization"]) == 1e-3
    assert float(new.parameters["regularization"]) > 1e-3


def test_replace_may_be_traced():
    def pitch_of(scene: dj.Scene, pitch: jax.Array) -> jax.Array:
        return jnp.sum(scene.replace(pitch=pitch).start.q ** 2)

    slope = jax.jit(jax.grad(pitch_of, argnums=1))(SCENE, 0.0445)
    ends = [float(pitch_of(SCENE, jnp.asarray(0.0445 + s * 1e-6))) for s in (-1, 1)]
    assert float(slope) == pytest.approx((ends[1] - ends[0]) / 2e-6, rel=1e-6)


def test_replace_refuses_what_it_would_lose():
    head = SCENE[dj.HeadDrag]
    terms = [t if t is not head else jax.tree.map(lambda x: 2.0 * x, t) for t in SCENE.terms]
    changed = dj.Scene(**{**vars(SCENE), "terms": tuple(terms)})
    with pytest.raises(ValueError, match=r"numbers of HeadDrag"):
        changed.replace(pitch=0.05)
    fewer = dj.Scene(**{**vars(SCENE), "terms": SCENE.terms[1:]})
    with pytest.raises(ValueError, match=r"built with the terms"):
        fewer.replace(pitch=0.05)
    with pytest.raises(KeyError, match=r"no parameter 'Pitch'; the scene has .*pitch"):
        SCENE.replace(Pitch=0.05)
    with pytest.raises(dj.InputError, match="pitch"):
        SCENE.replace(pitch=-0.05)


def test_terms_by_type():
    assert float(SCENE[dj.HeadDrag].radius) == pytest.approx(0.031)
    with pytest.raises(KeyError, match="0 terms are a Contact; the scene has Stretch"):
        SCENE[dj.Contact]


def test_a_scene_made_by_hand_says_what_it_lacks():
    by_hand = dj.Scene(
        SCENE.rod, SCENE.terms, SCENE.motor, SCENE.newton, SCENE.step_length, SCENE.scheme
    )
    with pytest.raises(ValueError, match="no initial state"):
        dj.rollout(by_hand, end=0.2)
    with pytest.raises(ValueError, match="end: must be given"):
        dj.rollout(by_hand, state=SCENE.start)
    with pytest.raises(ValueError, match="built from a scene file"):
        by_hand.replace(pitch=0.05)
    run = dj.rollout(by_hand, end=0.2, frame=0.04, state=SCENE.start)
    np.testing.assert_allclose(run.last.q, swum().last.q, atol=1e-12)


def trap(x: jax.Array, stiffness: jax.Array, target: jax.Array) -> jax.Array:
    return 0.5 * stiffness * jnp.sum((x[0] - target) ** 2)


def with_trap(stiffness: float | jax.Array) -> dj.Scene:
    """The last node held softly by its place at rest, a little aside."""
    target = dj.positions(SCENE.rod.topology, SCENE.start.q)[-1] + jnp.array([0.0, 1e-3, 0.0])
    return SCENE.with_term(dj.Energy(trap, nodes=[-1], data=(stiffness, target)))


@pytest.mark.slow
def test_an_own_energy_is_one_line():
    """It pulls, is stored, and can be differentiated."""
    run = dj.rollout(with_trap(1.0))
    assert run.stats.ok
    found = dj.energies(run.scene, run.last)["Energy"]
    target = run.scene[dj.Energy].data[1]
    gap = run.positions[-1, -1] - target
    assert float(found) == pytest.approx(0.5 * float(gap @ gap), rel=1e-12)
    force = dj.forces(run.scene, run.last)["Energy"]
    np.testing.assert_allclose(force[-1], -gap, rtol=1e-9)
    np.testing.assert_array_equal(force[:-1], 0.0)
    assert abs(float(run.positions[-1, -1, 1] - swum().positions[-1, -1, 1])) > 1e-5

    def end(stiffness):
        return dj.rollout(with_trap(stiffness)).positions[-1, -1, 1]

    both = jax.jit(lambda stiffness: jax.jvp(end, (stiffness,), (1.0,)))
    slope = float(both(1.0)[1])
    ends = [float(both(1.0 + s * 1e-4)[0]) for s in (-1, 1)]
    assert slope == pytest.approx((ends[1] - ends[0]) / 2e-4, rel=1e-5)
    assert run.scene.replace(pitch=0.05)[dj.Energy].nodes == (-1,)


def test_an_energy_of_a_node_that_is_not_there():
    scene = SCENE.with_term(dj.Energy(trap, nodes=[99], data=(1.0, jnp.zeros(3))))
    with pytest.raises(IndexError, match="there is no node 99"):
        dj.rollout(scene)


def test_all_forces_add_up_to_nothing_but_the_step_error():
    """What elasticity, the fluid, and inertia do to the nodes balances at the end of a step."""
    found = dj.forces(SCENE, swum().last)
    assert {"Stretch", "Bend", "Twist", "HeadDrag", "ResistiveDrag", "Inertia"} == set(found)
    total = sum(found.values())
    size = max(float(jnp.abs(f).max()) for f in found.values())
    # Drag is taken in the middle of the step, and here at its end.
    assert float(jnp.abs(total).max()) < 0.05 * size
    for name in ("Stretch", "Bend", "Twist"):
        np.testing.assert_allclose(np.sum(found[name], axis=0), 0.0, atol=1e-12 * size)


def test_the_potential_of_a_step_is_stationary_at_its_end():
    start = SCENE.start
    first = dj.rollout(SCENE, end=0.04, frame=0.02)
    state = jax.tree.map(lambda leaf: leaf[0], first.states)

    @jax.jit
    def expand(q: jax.Array) -> tuple[jax.Array, jax.Array]:
        potential = dj.potential(SCENE, state, 0.02)
        return potential.gradient(q), potential.hessian(q)

    gradient, hessian = expand(first.states.q[1])
    residual = jnp.abs(gradient / SCENE.newton.force_scale)
    at_start = jnp.abs(expand(start.q)[0] / SCENE.newton.force_scale)
    assert float(residual.max()) < 1e-6 * float(at_start.max())
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-9 * np.abs(hessian).max())


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["dense", "blocks"])
def test_resistance_is_that_of_the_head_and_the_flagellum(solver):
    """Symmetric and positive; without the flagellum's drag, that of a ball."""
    tables = TABLES | {"fluid": {"hydrodynamics": "rss"}, "solver": {"method": solver}}
    scene = dj.build(dj.SceneFile.from_dict(tables))
    matrix = np.asarray(dj.resistance(scene))
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-9 * np.abs(matrix).max())
    assert np.linalg.eigvalsh(matrix).min() > 0
    alone = dj.Scene(**{**vars(scene), "terms": (scene[dj.HeadDrag],)})
    ball = np.asarray(dj.resistance(alone))
    head = scene[dj.HeadDrag]
    expected = np.diag([*[float(head.translation)] * 3, float(head.spin), 0.0, 0.0])
    np.testing.assert_allclose(ball, expected, atol=1e-12)
    assert matrix[0, 0] > ball[0, 0]
    about = jnp.array([0.0, 0.0, 0.1])
    moved = np.asarray(dj.resistance(scene, about=about))
    x, y, z = dj.positions(scene.rod.topology, scene.start.q)[0] - about
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    shift = np.block([[np.eye(3), -cross], [np.zeros((3, 3)), np.eye(3)]])
    np.testing.assert_allclose(moved, shift.T @ matrix @ shift, atol=1e-9 * np.abs(moved).max())


def test_robots_by_keyword():
    file = dj.robots.two_flagella(pitch=0.0318, rpm=60, phase=0.5, time={"end": 5.0})
    given = {"kind": "two_flagella", "pitch": 0.0318, "phase": 0.5}
    tables = {"robot": given, "motor": {"rpm": 60}, "time": {"end": 5.0}}
    assert file == dj.SceneFile.from_dict(tables)
    assert dj.robots.branched(3).robot.count == 3
    with pytest.raises(dj.InputError, match=r"there is no such parameter; there are .*pitch"):
        dj.robots.single_flagellum(pich=0.03)


def test_a_failed_step_is_told():
    scene = SCENE.with_term(dj.Energy(trap, nodes=[-1], data=(jnp.nan, jnp.zeros(3))))
    with pytest.warns(dj.SolverWarning, match="not finite"):
        run = dj.rollout(scene)
    with pytest.raises(dj.SolverError, match="not finite"):
        run.raise_if_failed()
    assert "failed" in repr(run)


def test_what_is_printed_fits_on_a_screen():
    for thing in (SCENE, swum(), FILE):
        assert len(repr(thing)) < 2500
        assert len(repr(thing).splitlines()) < 40


def test_figures_and_films(tmp_path):
    run = swum()
    figure = run.plot()
    assert figure is not None
    assert run.plot("bundle") is None
    assert run.film(tmp_path / "swim.gif", fps=5).stat().st_size > 1000
    with pytest.raises(ValueError, match=r"films end in \.gif, \.mp4, \.html"):
        run.film(tmp_path / "swim.avi")
    with pytest.raises(ValueError, match="no figure 'tracks'"):
        run.plot("tracks")


def test_public_names_are_names_of_derjax_and_no_modules():
    import types

    public = {name: value for name, value in vars(dj).items() if not name.startswith("_")}
    modules = {n for n, v in public.items() if isinstance(v, types.ModuleType)}
    own = {n for n in modules if n != "robots" and not vars(dj)[n].__name__.startswith("derjax.")}
    assert not own
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert {"rollout", "build", "load_scene", "Scene", "Run"} <= set(public)


@pytest.mark.parametrize("n_nodes", [41])
def test_a_rod_without_a_robot(n_nodes):
    """A cantilever under a small force at its end: F L^3 / 3 E I."""
    rod = dj.Rod.straight(n_nodes=n_nodes, length=0.1, radius=1e-3, fixed="start")
    weight = jnp.zeros(n_nodes).at[-1].set(1.0)
    load = dj.Gravity(weight, jnp.array([0.0, 0.0, -1e-3]))
    terms = (*dj.elasticity(rod, 1e9), dj.ResistiveDrag(1.0, 2.0), dj.SpinDrag(1e-6), load)
    scale = jnp.where(jnp.arange(rod.topology.n_dofs) < 3 * n_nodes, 1e-3, 1e-4)
    settings = dj.NewtonSettings(force_scale=scale)
    scene = dj.Scene(rod, terms, None, settings, 1e6, dj.euler, initial=rod.at_rest())
    run = dj.rollout(scene, end=2e6)
    assert run.stats.ok
    free = 0.1 - 0.1 / (n_nodes - 1)  # beyond the edge that is held
    expected = 1e-3 * free**3 / (3 * 1e9 * np.pi * 1e-3**4 / 4)
    assert float(-run.positions[-1, -1, 2]) == pytest.approx(expected, rel=0.03)


def test_rods_that_cannot_be():
    with pytest.raises(ValueError, match="three nodes"):
        dj.Rod.straight(2, 0.1, 1e-3)
    with pytest.raises(ValueError, match="should be 'start'"):
        dj.Rod.straight(5, 0.1, 1e-3, fixed="left")  # pyright: ignore[reportArgumentType]
    bare, _ = dj.at_rest(dj.chain(4), np.eye(4, 3))
    with pytest.raises(ValueError, match="no radius"):
        dj.elasticity(bare, 1e6)
    with pytest.raises(ValueError, match="has no nodes"):
        bare.at_rest()
