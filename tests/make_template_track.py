"""Makes derjax/scenes/templates/track.csv: run it again when the physics has changed."""

from pathlib import Path

import jax
import numpy as np

import derjax

TEMPLATES = Path(derjax.__file__).parent / "scenes" / "templates"
TRUTH = {"C_t": 4.0, "C_r": 0.45}
NOISE_MM, NOISE_RAD = 0.1, 0.02

if __name__ == "__main__":
    file = derjax.load_scene(TEMPLATES / "scene.toml")
    scene = derjax.build(file, TRUTH)
    start = scene.start
    run = jax.jit(derjax.roll_frames, static_argnums=(2, 3))
    n_frames = round(file.time.end)
    states, report = run(scene, start, n_frames, file.n_steps // n_frames)
    report.raise_if_failed()
    states = jax.tree.map(lambda first, rest: np.concatenate([first[None], rest]), start, states)
    topology = scene.rod.topology
    head = 1e3 * np.asarray(derjax.positions(topology, states.q))[:, 0]
    angle = np.asarray(derjax.angles(topology, states.q) + 2 * np.pi * states.turns)[:, 0]
    noise = np.random.default_rng(1).normal(size=(len(head), 4))
    head = head + NOISE_MM * noise[:, :3]
    angle = angle + NOISE_RAD * noise[:, 3]
    rows = np.column_stack([states.time, head, angle])
    with (TEMPLATES / "track.csv").open("w", encoding="utf-8") as table:
        table.write("t,hx,hy,hz,th0\n")
        np.savetxt(table, rows, fmt=["%.0f", "%.3f", "%.3f", "%.3f", "%.4f"], delimiter=",")
