"""Many runs in one program: each is what it would be alone, on however many devices."""

import json
import os
import subprocess
import sys
import threading
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from derjax import RolloutStats, Scene, SceneFile, State, Status, build, march_frames, roll_frames
from derjax.core.pytree import replace
from derjax.runs import batch, turns
from derjax.runs.batch import (
    ALL,
    advance,
    all_runs,
    build_many,
    local_runs,
    march_many,
    pick,
    repeat,
    shard,
    stack,
)

FILE = SceneFile.model_validate(
    {
        "robot": {"edge_length": 0.03},
        "fluid": {"hydrodynamics": "rft"},
        "time": {"end": 0.4},
    }
)
N_FRAMES, STEPS = 4, 2
RATES = np.array([20.0, 55.0, 70.0, 100.0, 80.0])
PREFACTORS = np.array([4.0, 4.4, 4.8, 5.2, 5.6])

alone = jax.jit(march_frames, static_argnums=(2, 3))


def scenes_and_states() -> tuple[Scene, State]:
    scenes = build_many(FILE, {"rpm": RATES, "C_t": PREFACTORS})
    return scenes, scenes.start


@pytest.fixture(scope="module")
def singles() -> list[tuple[State, RolloutStats]]:
    """The same runs, one by one."""
    runs = []
    for rpm, prefactor in zip(RATES, PREFACTORS, strict=True):
        scene = build(FILE, {"rpm": rpm, "C_t": prefactor})
        state = scene.start
        runs.append(alone(scene, state, N_FRAMES, STEPS))
    return runs


def assert_same(
    batched: tuple[State, RolloutStats], runs: list[tuple[State, RolloutStats]]
) -> None:
    """To what Newton's method leaves open."""
    frames, reports = batched
    for k, (state, report) in enumerate(runs):
        np.testing.assert_allclose(pick(frames, k).q, state.q, rtol=0, atol=1e-9)
        np.testing.assert_allclose(pick(frames, k).time, state.time, rtol=1e-12)
        assert int(reports.status[k]) == int(report.status)
        assert int(reports.steps[k]) == int(report.steps)


def test_scenes_built_together_are_those_built_alone():
    scenes, _ = scenes_and_states()
    for k in (0, 3):
        one = build(FILE, {"rpm": RATES[k], "C_t": PREFACTORS[k]})
        one = replace(one, source=None)
        assert jax.tree.structure(pick(scenes, k)) == jax.tree.structure(one)
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-15),
            pick(scenes, k),
            one,
        )


@pytest.mark.parametrize(
    "lanes", [None, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, ALL))]
)
def test_runs_of_a_batch_are_those_alone(singles, lanes):
    assert_same(march_many(*scenes_and_states(), N_FRAMES, STEPS, lanes=lanes), singles)


def test_a_processor_that_is_free_takes_the_next_run(singles, monkeypatch):
    """The first run ends when all others have been done, which it would wait for in vain."""
    others = threading.Semaphore(0)

    def program(scene: Scene, *rest: Any) -> Any:
        if scene.parameters["rpm"] == RATES[0]:
            for _ in RATES[1:]:
                assert others.acquire(timeout=60)
        else:
            others.release()
        return compiled(scene, *rest)

    compiled = turns.program
    monkeypatch.setattr(turns, "program", program)
    monkeypatch.setattr(turns, "processors", lambda: 2)
    assert_same(march_many(*scenes_and_states(), N_FRAMES, STEPS), singles)


def test_other_numbers_use_the_same_program(monkeypatch):
    traced = []

    def traced_march(*arguments: Any) -> tuple[State, RolloutStats]:
        traced.append(arguments)
        return march_frames(*arguments)

    monkeypatch.setattr(batch, "march_frames", traced_march)
    scenes = build_many(FILE, {"viscosity": np.linspace(0.5, 1.0, 5), "rpm": RATES})
    states = scenes.start
    laid = shard(scenes, states)
    laid, _ = advance(laid, 1, STEPS)
    advance(laid, 1, STEPS)
    advance(shard(*scenes_and_states()), 1, STEPS)
    fewer = shard(pick(scenes, slice(3)), pick(states, slice(3)), slots=5)
    advance(fewer, 1, STEPS)
    assert len(traced) == 1


def test_initial_states_may_differ(singles):
    scene = build(FILE, {"rpm": RATES[1], "C_t": PREFACTORS[1]})
    state = scene.start
    later = pick(singles[1][0], 1)
    frames, reports = march_many(repeat(scene, 2), stack([state, later]), 2, STEPS)
    np.testing.assert_allclose(frames.q[0], singles[1][0].q[:2], atol=1e-9)
    np.testing.assert_allclose(frames.time[1], [0.3, 0.4])
    assert (reports.status == Status.OK).all()


def test_a_failed_run_does_not_disturb_the_others(singles):
    scenes, states = scenes_and_states()
    velocity = np.array(states.velocity)
    velocity[2] = np.nan
    frames, reports = march_many(scenes, replace(states, velocity=velocity), N_FRAMES, STEPS)
    assert reports.status[2] != Status.OK
    assert not pick(reports, 2).ok
    assert "t = 0 s failed" in pick(reports, 2).message()
    np.testing.assert_array_equal(frames.q[2], np.tile(states.q[2], (N_FRAMES, 1)))
    good = [0, 1, 3, 4]
    assert_same(pick((frames, reports), np.array(good)), [singles[k] for k in good])


@pytest.mark.slow
def test_a_batch_goes_on_where_it_stopped(singles):
    started = shard(*scenes_and_states())
    parts = []
    for _ in range(2):
        started, part = advance(started, N_FRAMES // 2, STEPS)
        parts.append(all_runs(started, part))
    frames = jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *parts)
    assert_same((frames, all_runs(started, started.reports)), singles)
    numbers, reports = local_runs(started, started.reports)
    assert numbers.tolist() == [0, 1, 2, 3, 4]
    np.testing.assert_array_equal(reports.steps, [int(r.steps) for _, r in singles])


@pytest.mark.slow
def test_derivatives_of_a_batch():
    """Reverse and forward mode work under `vmap`, and agree."""
    file = SceneFile.model_validate(
        {
            "robot": {"edge_length": 0.03},
            "fluid": {"hydrodynamics": "none"},
            "head": {"rotation": "full"},  # or else nothing resists its tilt
            "time": {"step": 0.05, "end": 0.1, "scheme": "euler", "inertia": False},
        }
    )

    def reached(rpm: Any) -> Any:
        scene = build(file, {"rpm": rpm})
        states, _ = roll_frames(scene, scene.start, 1, 2)
        return states.q[-1, -1]  # the angle of the last edge

    rates = jnp.asarray(RATES[:2])
    reverse = jax.jit(jax.vmap(jax.grad(reached)))(rates)
    forward = jax.jit(jax.vmap(lambda rpm: jax.jvp(reached, (rpm,), (1.0,))[1]))(rates)
    assert np.abs(reverse).min() > 0
    assert abs(reverse[0] / reverse[1] - 1) > 1e-3
    np.testing.assert_allclose(reverse, forward, rtol=1e-7)


PROGRAM = """
import json, sys, jax
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
if len(sys.argv) > 2:
    jax.distributed.initialize(sys.argv[2], 2, int(sys.argv[3]))
import numpy as np
from derjax import SceneFile
from derjax.runs.batch import advance, build_many, all_runs, local_runs, shard
file = SceneFile.model_validate_json({file!r})
scenes = build_many(file, {{"rpm": np.array({rates}), "C_t": np.array({prefactors})}})
batch = shard(scenes, scenes.start)
batch, frames = advance(batch, {n_frames}, {steps})
numbers, own = local_runs(batch, frames.q[:, -1, 0])
print(json.dumps({{
    "devices": jax.device_count(),
    "kept": len(batch.reports.steps.sharding.device_set),
    "numbers": numbers.tolist(),
    "own": own.tolist(),
    "all": all_runs(batch, frames).q[:, -1, 0].tolist(),
}}))
"""


def start(devices: int, *arguments: str) -> subprocess.Popen:
    """A process of its own that runs the batch on so many devices."""
    program = PROGRAM.format(
        file=FILE.model_dump_json(),
        rates=RATES.tolist(),
        prefactors=PREFACTORS.tolist(),
        n_frames=N_FRAMES,
        steps=STEPS,
    )
    return subprocess.Popen(
        [sys.executable, "-c", program, str(jax.config.jax_compilation_cache_dir), *arguments],
        env={
            **os.environ,
            "JAX_NUM_CPU_DEVICES": str(devices),
            "JAX_PLATFORMS": "cpu",
            "NPROC": "6",
        },
        stdout=subprocess.PIPE,
        text=True,
    )


def finished(process: subprocess.Popen) -> dict[str, Any]:
    out, _ = process.communicate(timeout=300)
    assert process.returncode == 0
    return json.loads(next(line for line in out.splitlines() if line.startswith("{")))


@pytest.mark.slow
def test_two_devices(singles):
    found = finished(start(2))
    assert (found["devices"], found["kept"]) == (2, 2)
    assert found["numbers"] == [0, 1, 2, 3, 4]
    expected = [float(states.q[-1, 0]) for states, _ in singles]
    np.testing.assert_allclose(found["all"], expected, atol=1e-9)
    assert found["own"] == found["all"]


@pytest.mark.slow
def test_two_processes(singles):
    """Each computes its own runs; all of them can be had everywhere."""
    import socket

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    processes = [start(1, address, str(k)) for k in range(2)]
    found = [finished(process) for process in processes]
    expected = np.array([float(states.q[-1, 0]) for states, _ in singles])
    assert [f["numbers"] for f in found] == [[0, 2, 4], [1, 3]]
    for f in found:
        assert f["devices"] == 2
        np.testing.assert_allclose(f["own"], expected[f["numbers"]], atol=1e-9)
        np.testing.assert_allclose(f["all"], expected, atol=1e-9)
