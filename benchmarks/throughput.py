"""How many runs a second one device makes, by the number of runs it takes at once.

    python -m benchmarks.throughput [-o docs/figures] [--sizes 1 4 16 64]

Robots of one and of two flagella, contact included, with motors of 20 to 100 rpm, in 50 steps of
20 ms: the runs as `derjax sweep` makes them, and for one flagellum also their gradients by two
parameters in reverse mode, as a fit from many starts takes them. On a GPU all runs of a batch are
lanes of one program, on a processor they follow each other. The first run of each batch is compared
with the same run alone. Times are wall times, the best of two. Writes throughput_<device>.csv, .md
and .png.
"""

import time
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import derjax
from derjax.runs.batch import build_many, march_many, pick
from derjax.scenes.file import SceneFile

from .batch import seconds
from .command import command_line
from .tables import write

STEPS, ROUNDS = 50, 2
SIZES = (1, 4, 16, 64)
TIME = {"step": 0.02, "end": 1.0}
ROBOTS = {
    "one flagellum": SceneFile.model_validate({"time": TIME}),
    "two flagella": SceneFile.model_validate({"robot": {"kind": "two_flagella"}, "time": TIME}),
}


def numbers(size: int) -> dict[str, np.ndarray]:
    """What differs between the runs of a batch."""
    return {"rpm": np.linspace(100.0, 20.0, size), "C_t": np.linspace(4.0, 6.0, size)}


def runs(file: SceneFile, size: int) -> Callable[[], np.ndarray]:
    """A batch, which gives the degrees of freedom of all runs at the end (runs, n_dof)."""

    def program() -> np.ndarray:
        scenes = build_many(file, numbers(size))
        states, reports = march_many(scenes, scenes.start, 1, STEPS, devices=jax.devices()[:1])
        failed = np.flatnonzero(reports.status)
        if failed.size:
            raise RuntimeError(f"{failed.size} of {size} runs failed, the first is {failed[0]}")
        return np.asarray(pick(states, (slice(None), -1)).q)

    return program


def gradients(file: SceneFile, size: int) -> Callable[[], np.ndarray]:
    """Derivatives (runs, 2) of a sum of squares at the end of each run."""

    def total(values: jax.Array) -> jax.Array:
        scene = derjax.build(file, {"C_t": values[0], "rpm": values[1]})
        return jnp.sum(derjax.roll_frames(scene, scene.start, 1, STEPS)[0].q ** 2)

    gradient = jax.jit(
        jax.vmap(jax.grad(total))
        if jax.default_backend() != "cpu"
        else lambda values: jax.lax.map(jax.grad(total), values)
    )
    values = jnp.stack([jnp.asarray(numbers(size)[name]) for name in ("C_t", "rpm")], axis=-1)
    return lambda: np.asarray(gradient(values))


def measure(
    what: str, make: Callable[[int], Callable[[], np.ndarray]], sizes: Sequence[int]
) -> list[dict]:
    """A row for each size; alone and in the largest batch the first run must be the same."""
    rows: list[dict] = []
    alone = make(1)()[0]
    for size in sizes:
        program = make(size)
        began = time.perf_counter()
        first = program()[0]
        compiled = time.perf_counter() - began
        best = min(seconds(program) for _ in range(ROUNDS))
        rows.append(
            {
                "what": what,
                "runs": size,
                "runs_per_s": size / best,
                "ratio": size / best / (rows[0]["runs_per_s"] if rows else 1 / best),
                "seconds": best,
                "first_call_s": compiled,
                "difference": float(np.abs(first - alone).max() / np.abs(alone).max()),
            }
        )
        print(rows[-1], flush=True)
    return rows


def figure(table: pd.DataFrame, device: str) -> plt.Figure:
    """Runs a second against the number of runs in the batch."""
    fig, axes = plt.subplots(figsize=(7, 4))
    for what, rows in table.groupby("what", sort=False):
        axes.plot(rows["runs"], rows["runs_per_s"], "o-", label=what)
    axes.set(xscale="log", yscale="log", xlabel="runs in the batch", ylabel="runs / s")
    axes.set_title(f"runs of {STEPS} steps, {device}", fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    fig.tight_layout()
    return fig


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, help="runs in a batch")
    arguments = parser.parse_args()
    device = jax.devices()[0]
    name = "cpu" if device.platform == "cpu" else device.device_kind
    rows: list[dict] = []
    one = ROBOTS["one flagellum"]
    for what, make in {
        **{key: lambda size, file=file: runs(file, size) for key, file in ROBOTS.items()},
        "one flagellum, with gradient": lambda size: gradients(one, size),
    }.items():
        rows += measure(what, make, arguments.sizes)
        table = pd.DataFrame(rows)
        path = arguments.output / f"throughput_{name.replace(' ', '_')}.csv"
        formats = {"what": "", "runs": "d", "runs_per_s": ".3g", "ratio": ".2f"}
        write(table, path, formats | {"difference": ".1e"}, f"On {name}.")
        figure(table, name).savefig(path.with_suffix(".png"), dpi=150)
        plt.close("all")


if __name__ == "__main__":
    main()
