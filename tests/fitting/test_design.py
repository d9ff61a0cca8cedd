"""Design: exact gradients of all that robots are judged by, and the best of them within limits."""

from dataclasses import replace as changed

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

import derjax as dj
from derjax.core.pytree import replace
from derjax.scenes.motortable import RateTable
from fitting.design import Search, Uncertain, design
from fitting.design.evaluate import ThroughRun, ThroughSteady
from fitting.design.outcome import problem_of, solved
from fitting.design.problem import Designs
from fitting.design.quantities import from_function, named
from fitting.design.search import Stop

FILE = dj.SceneFile.from_dict(
    {
        "robot": {"edge_length": 0.02, "pitch": 31.8e-3},
        "fluid": {"hydrodynamics": "rft"},
        "motor": {"rpm": 80.0},
    }
)
PITCH, RADIUS = (0.02, 0.06), (4e-3, 9e-3)
ONE = Search(starts=1)


@pytest.fixture(scope="module")
def scene() -> dj.Scene:
    return dj.build(FILE)


@pytest.fixture(scope="module")
def found(scene):
    """Speed made large by pitch and radius, with a limit to the torque, from two starts."""
    limits = {"torque": (None, 1.2e-4), "turn_gap": (5e-3, None)}
    vary = {"pitch": PITCH, "helix_radius": RADIUS}
    return design(scene, vary, maximise="speed", limits=limits, search=Search(starts=2))


def difference(evaluate, numbers, parameter, step):
    """The derivatives of all quantities by a parameter, to second order."""
    h = step * abs(numbers[parameter])
    ahead, behind = (evaluate({**numbers, parameter: numbers[parameter] + k * h}) for k in (1, -1))
    assert ahead.ok
    assert behind.ok
    return {name: (ahead.values[name] - behind.values[name]) / (2 * h) for name in ahead.values}


def differences(evaluate, numbers, name, parameter, step):
    """The derivative of a quantity by a parameter, to fourth order."""
    h = step * abs(numbers[parameter])

    def at(k: int) -> float:
        evaluation = evaluate({**numbers, parameter: numbers[parameter] + k * h})
        assert evaluation.ok, evaluation.failure
        return evaluation.values[name]

    return (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * h)


STEADY = (
    *("speed", "force", "torque", "power", "head_rate", "efficiency", "paper_efficiency"),
    *("contour_length", "mass", "total_length", "turn_gap", "growth_rate"),
)


@pytest.mark.slow
def test_gradients_through_steady_states_are_those_of_differences(scene):
    evaluate = ThroughSteady(scene, [named(name, scene) for name in STEADY])
    numbers = {"pitch": 0.0318, "head_radius": 0.031}
    exact = evaluate(numbers)
    assert set(exact.values) == set(STEADY)
    for parameter in numbers:
        for name in STEADY:
            slope = exact.slopes[name][parameter]
            size = abs(exact.values[name] / numbers[parameter])
            seen = differences(evaluate, numbers, name, parameter, 2e-3)
            assert seen == pytest.approx(slope, rel=1e-6, abs=1e-7 * size), (name, parameter)


def test_efficiencies_are_what_they_say(scene):
    state = dj.steady(scene)
    evaluate = ThroughSteady(scene, [named(name, scene) for name in STEADY])
    values = evaluate({"pitch": 0.0318, "head_radius": 0.031}).values
    drag = 4.8 * 6 * np.pi * 0.031  # viscosity 1
    assert values["speed"] == pytest.approx(abs(float(state.speed)))
    assert values["force"] == pytest.approx(drag * values["speed"])
    assert values["power"] == pytest.approx(values["torque"] * 80 * 2 * np.pi / 60)
    # Nothing else holds the robot: the motor's torque is what turns the head.
    spinning = 0.36 * 8 * np.pi * 0.031**3 * values["head_rate"]
    assert values["torque"] == pytest.approx(spinning, rel=1e-6)
    assert values["efficiency"] == pytest.approx(drag * values["speed"] ** 2 / values["power"])
    assert values["paper_efficiency"] == pytest.approx(values["force"] * 0.031 / spinning)


def test_the_best_design_is_that_of_a_grid(scene, found):
    """Of those that keep to all limits; the torque binds."""
    assert found.status == "converged"
    assert found.binding == ("torque <= 0.00012",)
    assert found.quantities["torque"] <= 1.2e-4 * (1 + 1e-5)
    evaluate = ThroughSteady(scene, [named(n, scene) for n in ("speed", "torque", "turn_gap")])
    best = 0.0
    for pitch in np.linspace(*PITCH, 7):
        for radius in np.linspace(*RADIUS, 11):
            values = evaluate({"pitch": pitch, "helix_radius": radius}).values
            if values["torque"] <= 1.2e-4 and values["turn_gap"] >= 5e-3:
                best = max(best, values["speed"])
    assert best < found.objective < 1.1 * best
    assert found.objective > 1.05 * found.start.objective
    # From both starts to the same.
    ends = [attempt.end.objective for attempt in found.attempts]
    np.testing.assert_allclose(ends, found.objective, rtol=1e-5)


def test_the_best_design_is_a_scene(found):
    assert float(dj.steady(found.scene).speed) == pytest.approx(-found.objective, rel=1e-9)


@pytest.mark.slow
def test_tolerances_are_those_that_cost_one_percent(scene):
    found = design(scene, {"pitch": PITCH}, maximise="speed", search=ONE)
    tolerance = found.sensitivities["pitch"].tolerance
    evaluate = ThroughSteady(scene, [named("speed", scene)])
    lost = [
        1 - evaluate({"pitch": found.values["pitch"] + side}).values["speed"] / found.objective
        for side in (-tolerance, tolerance)
    ]
    assert np.mean(lost) == pytest.approx(0.01, rel=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("held", [("torque", 8e-5), ("power", 1e-3)])
def test_a_motor_that_is_held_at_its_torque_or_power(scene, held):
    problem = problem_of(scene, {"pitch": PITCH}, "speed", None, at=held, limits={held[0]: (0, 1)})
    evaluate = problem.evaluator()
    exact = evaluate({"pitch": 0.03})
    assert exact.values[held[0]] == pytest.approx(held[1], rel=1e-8)
    assert exact.slopes[held[0]]["pitch"] == pytest.approx(0.0, abs=1e-12)
    for name in ("speed", "rpm"):
        seen = differences(evaluate, {"pitch": 0.03}, name, "pitch", 2e-3)
        assert seen == pytest.approx(float(exact.slopes[name]["pitch"]), rel=1e-6)


TOUCHING = dj.SceneFile.from_dict(
    {
        "robot": {
            "kind": "two_flagella",
            "edge_length": 0.015,
            "separation": 8e-3,
            "axial_length": 0.06,
            "phase": [np.pi, np.pi - 0.4],
        },
        "fluid": {"hydrodynamics": "rft"},
        "motor": {"rpm": [60.0, 50.0]},
        "contact": {"capacity": 4},
        "time": {"step": 0.01, "end": 1.2, "frame": 0.1, "inertia": False},
        "solver": {"tolerance": 1e-11},
    }
)
AHEAD = (-1.0, 0.3, 0.2)
RUN = ("speed", "torque", "power", "efficiency", "energy", "clearance", "distance")


@pytest.mark.slow
def test_gradients_through_runs_with_contact_are_those_of_differences():
    """Between flagella that touch, with a list of contacts that was too short at first."""
    scene = dj.build(TOUCHING)
    quantities = [named(name, scene) for name in RUN] + [named("heading", scene, AHEAD)]
    evaluate = ThroughRun(scene, quantities, begin=0.6)
    numbers = {"pitch": 0.0445, "phase[1]": np.pi - 0.4, "rpm[1]": 50.0}
    exact = evaluate(numbers)
    assert exact.ok, exact.failure
    assert evaluate.enlargements > 0
    assert exact.values["clearance"] < 0.0  # they touch: contact is not hard
    for parameter, value in numbers.items():
        for name, seen in difference(evaluate, numbers, parameter, 1e-5).items():
            slope, size = float(exact.slopes[name][parameter]), abs(exact.values[name] / value)
            assert seen == pytest.approx(slope, rel=1e-5, abs=1e-6 * size), (name, parameter)


PROGRAMME = 26


@pytest.mark.slow
def test_a_programme_of_the_motor_in_reverse_mode():
    """How to go furthest on a given energy; a little further than at a steady rate."""
    slow = FILE.model_copy(update={"time": FILE.time.model_copy(update={"inertia": False})})
    times = np.linspace(0.0, 1.0, PROGRAMME)
    content = {
        **slow.model_dump(exclude_unset=True),
        "time": {"step": 0.04, "end": 1.0, "frame": 0.04, "inertia": False},
    }
    file = dj.SceneFile.from_dict(content)
    table = {"time": tuple(times), "rpm": (60.0,) * PROGRAMME}
    scene = dj.build(file.model_copy(update={"motor_table": RateTable(**table)}))
    limits = {"energy": (None, 5e-4)}
    found = design(
        scene,
        {"rpm": (0.0, 150.0)},
        maximise="distance",
        limits=limits,
        through="run",
        search=Search(starts=1, most=40),
    )
    assert found.problem.variables.size == PROGRAMME
    evaluate, rates = found.problem.evaluator(), 60.0 + 30.0 * np.sin(6.0 * times)
    exact = evaluate({"rpm": rates})
    for entry in (0, 11, PROGRAMME - 1):
        step = 1e-2 * np.eye(PROGRAMME)[entry]
        ahead, behind = (evaluate({"rpm": rates + sign * step}) for sign in (1, -1))
        for name in ("distance", "energy"):
            seen = (ahead.values[name] - behind.values[name]) / 2e-2
            assert seen == pytest.approx(exact.slopes[name]["rpm"][entry], rel=1e-5, abs=1e-12)
    assert found.quantities["energy"] <= 5e-4 * (1 + 1e-5)
    # Among programmes are steady rates: the best of them has less than the best of all.
    low, high = 0.0, 150.0
    for _ in range(30):
        middle = 0.5 * (low + high)
        steady_rate = evaluate({"rpm": np.full(PROGRAMME, middle)}).values
        low, high = (middle, high) if steady_rate["energy"] < 5e-4 else (low, middle)
    assert steady_rate["distance"] < found.objective < 1.1 * steady_rate["distance"]


ACROSS = 2.0
"""Drag across a filament over that along it."""


def _resistances(scene: dj.Scene):
    """Axial resistance to translation, coupling, and resistance to rotation of a helix."""
    drag = dj.ResistiveDrag(jnp.asarray(1.0), jnp.asarray(ACROSS))
    matrix = dj.resistance(replace(scene, terms=(drag,)))
    return matrix[0, 0], matrix[0, 3], matrix[3, 3]


def purcell(scene):
    """The largest efficiency that a helix can have, that with the best head."""
    along, coupling, turn = _resistances(scene)
    rest = jnp.sqrt(1 - coupling**2 / (along * turn))
    return (1 - rest) / (1 + rest)


def advance(scene):
    """Speed of a free helix, over the speed of its surface."""
    along, coupling, _ = _resistances(scene)
    return jnp.abs(coupling / along) / scene.parameters["helix_radius"]


def thrust_per_torque(scene):
    _, coupling, turn = _resistances(scene)
    return jnp.abs(coupling / turn) * scene.parameters["helix_radius"]


@pytest.mark.parametrize(
    ("objective", "tangent", "value"),
    [
        (purcell, 1.0, ((ACROSS**0.5 - 1) / (ACROSS**0.5 + 1)) ** 2),
        (advance, ACROSS**-0.5, (ACROSS - 1) / (2 * ACROSS**0.5)),
        (thrust_per_torque, ACROSS**0.5, (ACROSS - 1) / (2 * ACROSS**0.5)),
    ],
)
def test_long_helices_are_as_resistive_force_theory_says(objective, tangent, value):
    """Best angles of infinite helices, and what they achieve: the longer, the nearer."""
    radius, errors = 0.01, []
    turn = 2 * np.pi * radius
    for turns in (2, 6):
        scene = dj.build(
            dj.robots.clamped(
                1,
                helix_radius=radius,
                pitch=turn,
                axial_length=turns * turn,
                edge_length=turn / 40,
                rod_radius=1e-4,
                contact={"method": "none"},
                fluid={"hydrodynamics": "rft"},
            )
        )
        found = design(
            scene, {"pitch": (0.4 * turn, 2 * turn)}, maximise=objective, through="rest", search=ONE
        )
        errors.append((turn / found.values["pitch"] / tangent - 1, found.objective / value - 1))
    assert np.all(np.abs(errors[1]) < np.abs(errors[0]))
    assert abs(errors[1][0]) < 0.02
    assert abs(errors[1][1]) < 0.05


UNCERTAIN = Uncertain(("C_t", "C_r"), np.array([1.0, 1.0]), np.array([[4e-2, 1e-2], [1e-2, 9e-2]]))


@pytest.mark.parametrize("quantile", [None, 0.1])
def test_statistics_of_uncertain_parameters(quantile):
    """Of a quadratic objective with known mean and variance, and their derivatives."""
    uncertain = changed(UNCERTAIN, quantile=quantile)
    points, _ = uncertain.points()

    def statistic(x):
        values = x * points[:, 0] + x**2 * points[:, 1]
        gradients = (points[:, 0] + 2 * x * points[:, 1])[:, None]
        return uncertain.statistic(values, gradients)

    value, gradient = statistic(0.7)
    way = np.array([0.7, 0.49])
    spread = np.sqrt(way @ UNCERTAIN.covariance @ way)
    exact = way.sum() + (0.0 if quantile is None else norm.ppf(quantile) * spread)
    assert value == pytest.approx(exact)
    seen = (statistic(0.7 + 1e-5)[0] - statistic(0.7 - 1e-5)[0]) / 2e-5
    assert gradient[0] == pytest.approx(seen, rel=1e-7)


@pytest.mark.slow
def test_a_cautious_design_gives_up_a_little_of_the_mean(scene):
    """The tenth percentile is less than the mean, and what draws of the parameters say it is."""
    covariance = np.diag([0.3**2, 1e5**2])
    uncertain = Uncertain(("C_t", "youngs_modulus"), np.array([4.0, 1.255e6]), covariance, 0.1)
    found = design(
        scene,
        {"pitch": PITCH},
        maximise="speed",
        limits={"torque": (None, 1.0)},
        uncertain=uncertain,
        search=ONE,
    )
    assert found.status == "converged"
    assert found.spread.size
    assert np.quantile(found.spread, 0.1) == pytest.approx(found.objective, rel=0.02)
    assert found.objective < found.spread.mean()
    # The scene that is handed back has the means of the parameters, not those it came with.
    assert float(found.scene.parameters["C_t"]) == 4.0
    speed = abs(float(dj.steady(found.scene).speed))
    assert speed == pytest.approx(found.quantities["speed"], rel=1e-9)


@pytest.mark.slow
def test_a_search_goes_on_where_it_stopped(scene):
    """What it is told of designs that are known is all that it needs."""
    problem = problem_of(scene, {"pitch": PITCH, "helix_radius": RADIUS}, "speed", None)
    whole = solved(Designs(problem), ONE)
    seen = []

    def first_four(point):
        seen.append(point)
        if len(seen) == 4:
            raise Stop

    stopped = solved(Designs(problem, on_point=first_four), ONE)
    assert stopped.status == "interrupted"
    assert len(stopped.points) == 4
    assert stopped.objective <= whole.objective
    more = []
    resumed = solved(Designs(problem, list(seen), on_point=more.append), ONE)
    assert resumed.objective == pytest.approx(whole.objective, rel=1e-7)
    known = {point.x.tobytes() for point in seen}
    assert more
    assert not known & {point.x.tobytes() for point in more}


@pytest.mark.slow
def test_a_search_that_stops_between_starts_is_interrupted(scene):
    """And has the best of the first."""
    problem = problem_of(scene, {"pitch": PITCH}, "speed", None)
    ends = []

    def after_the_first(point):
        if ends:
            raise Stop

    found = solved(
        Designs(problem, on_point=after_the_first),
        Search(starts=3),
        lambda number, attempt: ends.append(attempt.end.objective),
    )
    assert found.status == "interrupted"
    assert ends == [found.objective]


@pytest.mark.slow
@pytest.mark.parametrize("method", ["trust-constr", "adam"])
def test_other_optimisers_find_the_same(scene, method):
    search = Search(method, starts=1, most=60, tolerance=1e-8)
    found = design(scene, {"pitch": PITCH}, maximise="speed", search=search)
    best = design(scene, {"pitch": PITCH}, maximise="speed", search=ONE)
    assert found.objective == pytest.approx(best.objective, rel=1e-5)


@pytest.mark.slow
def test_limits_that_contradict_each_other_are_named(scene):
    limits = {"torque": (None, 1e-4), "speed": (9e-4, None), "total_length": (None, 1.0)}
    with pytest.raises(dj.InputError, match=r"torque <= 0.0001 .* and speed >= 0.0009") as told:
        design(scene, {"helix_radius": RADIUS}, maximise="speed", limits=limits, search=ONE)
    assert "total_length" not in str(told.value)


@pytest.mark.slow
def test_a_start_beyond_the_limits_is_led_back(scene):
    limits = {"torque": (None, 5e-5)}
    found = design(scene, {"helix_radius": RADIUS}, maximise="speed", limits=limits, search=ONE)
    assert found.start.values["torque"] > 5e-5
    assert found.quantities["torque"] == pytest.approx(5e-5, rel=1e-4)


@pytest.mark.slow
def test_a_design_that_buckles_is_told(scene):
    fast = scene.replace(rpm=250.0)
    found = design(fast, {"pitch": (0.025, 0.035)}, maximise="speed", search=ONE)
    assert any("unstable" in warning for warning in found.warnings)
    kept = design(
        scene.replace(rpm=150.0),
        {"rpm": (100.0, 300.0)},
        maximise="head_rate",
        limits={"growth_rate": (None, 0.0)},
        search=ONE,
    )
    assert kept.quantities["growth_rate"] == pytest.approx(0.0, abs=1e-6)
    assert kept.binding
    assert not kept.warnings  # at the limit of its stability, it is not beyond it


def never(state):
    return 0.0 * state.speed / 0.0


def by_value(state):
    return float(state.speed)


def a_vector(state):
    return state.motion.velocity


def in_steps(state):
    return jnp.round(1e6 * state.speed)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"maximise": "sped"}, "did you mean 'speed'"),
        ({"maximise": "clearance"}, "two flagella or more"),
        ({"maximise": "heading"}, "needs a direction"),
        ({"maximise": "distance"}, "not known with through = 'steady', but with 'run'"),
        ({"maximise": "speed", "minimise": "power"}, "one of maximise and minimise"),
        ({"maximise": "speed", "vary": {"pitch": (0.05, 0.06)}}, "the scene has 0.0318"),
        ({"maximise": "speed", "vary": {"pitch": (0.06, 0.02)}}, "not in order"),
        ({"maximise": "speed", "vary": {"pich": (0.02, 0.06)}}, "no parameter 'pich'"),
        ({"maximise": "speed", "vary": {}}, "nothing to vary"),
        (
            {"maximise": "speed", "uncertain": Uncertain(("c_t",), np.ones(1), np.eye(1))},
            "c_t: the scene has no such parameter",
        ),
        ({"maximise": "speed", "limits": {"torque": (2.0, 1.0)}}, "contradict each other"),
        ({"maximise": "speed", "at": ("speed", 1e-3)}, "held at its torque or power"),
        (
            {"maximise": "speed", "at": ("torque", 1e-4), "vary": {"rpm": (10.0, 90.0)}},
            "cannot be varied",
        ),
        (
            {"maximise": "turn_gap", "vary": {"pitch": PITCH, "head_radius": (0.02, 0.04)}},
            "head_radius: has no effect",
        ),
        ({"maximise": by_value}, "by_value: is not differentiable as it stands"),
        ({"maximise": a_vector}, "must return one number"),
        ({"maximise": in_steps}, "it is not differentiable"),
        ({"maximise": "mass", "vary": {"C_t": (0.5, 5.0)}}, "does not change with C_t"),
        (
            {"maximise": "speed", "search": Search("adam"), "limits": {"torque": (None, 1.0)}},
            "knows no constraints",
        ),
    ],
)
def test_what_cannot_be_is_told_in_one_message(scene, arguments, message):
    given = {"vary": {"pitch": PITCH}, "search": ONE} | arguments
    with pytest.raises(dj.InputError, match=message):
        design(scene, given.pop("vary"), **given)


@pytest.mark.slow
def test_an_objective_that_is_no_number_is_told(scene):
    with pytest.raises(dj.SolverError, match="never is nan"):
        design(scene, {"pitch": PITCH}, maximise=never, search=ONE)


@pytest.mark.slow
def test_a_start_that_fails_leaves_the_others(scene):
    """A design without a steady state is bad, and no more than that."""

    def cut_off(state):
        pitch = state.scene.parameters["pitch"]
        return jnp.where(pitch < 0.05, jnp.abs(state.speed), jnp.nan)

    found = design(scene, {"pitch": (0.02, 0.08)}, maximise=cut_off, search=Search(starts=4))
    assert found.values["pitch"] < 0.05
    assert np.isfinite(found.objective)
    assert any(attempt.status == "failed" for attempt in found.attempts)
    assert any("cut_off is nan" in attempt.message for attempt in found.attempts)
    assert from_function(cut_off, "cut_off").kind == "own"
