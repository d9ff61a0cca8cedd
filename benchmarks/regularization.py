"""What the regularization eps of Stokeslet segments does, and how it goes with radius and mesh.

    python -m benchmarks.regularization [-o docs/figures]

Writes regularization.csv, .md and .png:

- the drag of a straight rod, 50 times as long as thick, along and across, over that of a cylinder
  (Tirado & Garcia de la Torre, J. Chem. Phys. 71, 2581, 1979; 73, 1986, 1980) and of the prolate
  spheroid inscribed in it, for several eps and numbers of segments;
- the eps that gives the drag of a cylinder exactly, for several slendernesses. A uniform force on a
  thin rod of length 2 l moves its middle as 4 ln(2 l / eps) along and as 2 ln(2 l / eps) + 2
  across; slender body theory has 4 ln(2 l / a) - 2 and 2 ln(2 l / a) + 1 for a radius a, so that
  eps = sqrt(e) a in both directions (the segments are those of Cortez, J. Comput. Phys. 375, 783,
  2018; Zhao & Koens, arXiv:2109.07621, 2021, also find eps proportional to the radius);
- the forces near the end of the rod, which begin to oscillate from node to node when segments are
  short against eps: the equation for them is of the first kind;
- speed and head rate of the robot with one flagellum (pitch / radius = 7, 60 rpm, 10 s) for several
  eps and meshes.
"""

from functools import partial

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from scipy.optimize import brentq

import derjax
from derjax.integrate.frames import march_frames, new_stats
from derjax.results.dataset import to_dataset
from derjax.results.summary import summarise
from derjax.scenes.file import SceneFile

from .command import command_line
from .rigid import rigid_resistance, stokeslet_resistance
from .tables import markdown

ROOT_E = float(np.sqrt(np.e))
RATIOS = (0.104, 1.02, ROOT_E)
"""eps / rod radius: as the table of Lim, Yadunandan & Jawed (2023) prints it, as is usual in codes
of the same group, and as slender body theory has it."""

SEGMENTS = (10, 20, 40, 80, 160)
ASPECT = 50.0
ASPECTS = (20.0, 50.0, 100.0, 200.0)
ROBOT_RATIOS = (0.104, 0.3, 0.6, 1.02, ROOT_E, 2.5)
MESHES = (10e-3, 5e-3, 2.5e-3, 1.25e-3)
END, TOLERANCE = 10.0, 1e-3
"""s, and of steps that adapt, of implicit Euler, whose error is about 0.2 % on every mesh."""

COLOURS = ("#9cc9e8", "#328cc1", "#0b3c5d", "#c8792b")


def straight(n_segments: int) -> jax.Array:
    """Nodes of a rod of unit length."""
    return jnp.zeros((n_segments + 1, 3)).at[:, 0].set(jnp.linspace(-0.5, 0.5, n_segments + 1))


@partial(jax.jit, static_argnums=1)
def drag(eps: jax.Array, n_segments: int) -> tuple[jax.Array, jax.Array]:
    """Drag along and across of a rod of unit length, for unit viscosity."""
    nodes = straight(n_segments)
    total = rigid_resistance(nodes, stokeslet_resistance(nodes, 1.0, eps))
    return total[0, 0], total[1, 1]


def cylinder(aspect: float) -> tuple[float, float]:
    """Drag along and across of a cylinder of unit length with flat ends."""
    log = np.log(aspect)
    return (
        2 * np.pi / (log - 0.207 + 0.980 / aspect - 0.133 / aspect**2),
        4 * np.pi / (log + 0.839 + 0.185 / aspect + 0.233 / aspect**2),
    )


def spheroid(aspect: float) -> tuple[float, float]:
    """The same for the prolate spheroid inscribed in it (Oberbeck)."""
    e = np.sqrt(1 - aspect**-2)
    log = np.log((1 + e) / (1 - e))
    along = 8 * np.pi * e**3 / ((1 + e**2) * log - 2 * e)
    across = 16 * np.pi * e**3 / (2 * e + (3 * e**2 - 1) * log)
    return float(along), float(across)


def rods() -> pd.DataFrame:
    """Drag of the rod over that of the references, and how uneven the forces on it are."""
    rows = []
    for ratio in RATIOS:
        for n in SEGMENTS:
            eps = ratio * 0.5 / ASPECT
            along, across = (float(value) for value in drag(eps, n))
            rows.append(
                {
                    "what": "straight rod",
                    "eps / radius": ratio,
                    "segments": n,
                    "segment / eps": 1.0 / n / eps,
                    "along / cylinder": along / cylinder(ASPECT)[0],
                    "across / cylinder": across / cylinder(ASPECT)[1],
                    "along / spheroid": along / spheroid(ASPECT)[0],
                    "across / spheroid": across / spheroid(ASPECT)[1],
                    "sawtooth": sawtooth(density(eps, n)),
                }
            )
    return pd.DataFrame(rows)


def density(eps: float, n_segments: int) -> np.ndarray:
    """Force per length at every node of the rod as it moves across itself, over the mean."""
    matrix = stokeslet_resistance(straight(n_segments), 1.0, eps)
    force = np.asarray(matrix)[1::3, 1::3].sum(axis=1)
    weight = np.full(n_segments + 1, 1.0 / n_segments)
    weight[[0, -1]] *= 0.5
    return force / weight / force.sum()


def sawtooth(values: np.ndarray) -> float:
    """By how much values go up and down from one node to the next: of a smooth curve, little.

    The largest amplitude that changes its sign from node to node: (1, -3, 3, -1) / 8 lets a
    sawtooth through as it is, and nothing of a parabola.
    """
    return float(abs(np.convolve(values, np.array([1, -3, 3, -1]) / 8, mode="valid")).max())


def equivalents() -> pd.DataFrame:
    """eps / radius with which a rod has the drag of a cylinder, along and across."""
    rows = []
    for aspect in ASPECTS:
        radius = 0.5 / aspect
        n = round(1.0 / (3.0 * radius))  # segments of some two eps

        def excess(ratio: float, way: int, n: int = n, aspect: float = aspect) -> float:
            return float(drag(ratio * 0.5 / aspect, n)[way]) - cylinder(aspect)[way]

        along, across = (brentq(excess, 0.3, 4.0, args=(way,)) for way in (0, 1))
        rows.append({"length / diameter": aspect, "along": along, "across": across})
    return pd.DataFrame(rows)


_march = jax.jit(march_frames, static_argnums=2)


def robots() -> pd.DataFrame:
    """Speed and head rate of the robot."""
    rows = []
    for mesh in MESHES:
        for ratio in ROBOT_RATIOS:
            radius = SceneFile().robot.rod_radius
            times = {"end": END, "scheme": "euler", "tolerance": TOLERANCE}
            plain = SceneFile.model_validate({"robot": {"edge_length": mesh}, "time": times})
            # eps stays out of the scene file, so that there is one program for every mesh.
            scene = derjax.build(plain, {"regularization": ratio * radius})
            state = scene.start
            steps = jnp.asarray(plain.steps_per_frame)
            states, report = _march(scene, state, plain.n_frames, steps, new_stats())
            frames = jax.tree.map(lambda a, b: np.concatenate([a[None], b]), state, states)
            summary = summarise(to_dataset(scene, frames))
            edge = float(scene.rod.rest_length[0])
            rows.append(
                {
                    "what": "robot",
                    "eps / radius": ratio,
                    "edge, mm": 1e3 * edge,
                    "segment / eps": edge / ratio / radius,
                    "v_x, mm/s": 1e3 * summary["v_x_m_per_s"] if report.ok else np.nan,
                    "head rate, rad/s": summary["head_rate_rad_per_s"] if report.ok else np.nan,
                    "message": "" if report.ok else report.message(),
                }
            )
            print(rows[-1], flush=True)
    return pd.DataFrame(rows)


def figure(rod: pd.DataFrame, robot: pd.DataFrame) -> plt.Figure:
    """Drag against mesh and eps, forces at the end, and the robot."""
    fig, axes = plt.subplots(2, 3, figsize=(13, 7.6), layout="constrained")
    for ratio, colour in zip(RATIOS, COLOURS, strict=False):
        part = rod[rod["eps / radius"] == ratio]
        for way, line in (("along", "o-"), ("across", "s--")):
            label = rf"$\varepsilon = {ratio:.3g}\,r_0$, {way}"
            axes[0, 0].plot(
                part.segments, part[f"{way} / cylinder"], line, color=colour, ms=4, label=label
            )
        near = part[part["segment / eps"] < 12]
        axes[0, 2].plot(
            near["segment / eps"],
            near.sawtooth,
            "o-",
            color=colour,
            ms=4,
            label=rf"$\varepsilon = {ratio:.3g}\,r_0$",
        )
    axes[0, 0].axhline(1.0, color="black", lw=0.8)
    axes[0, 0].set(xscale="log", xlabel="segments", ylabel="drag / that of the cylinder")
    axes[0, 0].set_xticks(SEGMENTS, [str(n) for n in SEGMENTS], minor=False)
    axes[0, 0].minorticks_off()
    axes[0, 0].set_title("rod of 50 diameters", loc="left", fontsize="medium")
    axes[0, 0].legend(frameon=False, fontsize="x-small", loc=(0.5, 0.3))

    ratios = np.linspace(0.1, 3.0, 40)
    for k, (way, line) in enumerate((("along", "-"), ("across", "--"))):
        values = [float(drag(r * 0.5 / ASPECT, 40)[k]) / cylinder(ASPECT)[k] for r in ratios]
        axes[0, 1].plot(ratios, values, line, color="#0b3c5d", label=way)
        inside = spheroid(ASPECT)[k] / cylinder(ASPECT)[k]
        axes[0, 1].axhline(inside, color="#c8792b", lw=0.8, ls=line, label=f"spheroid, {way}")
    axes[0, 1].axhline(1.0, color="black", lw=0.8)
    axes[0, 1].axvline(ROOT_E, color="0.5", lw=0.8, ls=":")
    axes[0, 1].text(ROOT_E + 0.04, 0.6, r"$\sqrt{e}$", color="0.4")
    axes[0, 1].set(xlabel=r"$\varepsilon / r_0$", ylabel="drag / that of the cylinder")
    axes[0, 1].set_title("the same, 40 segments", loc="left", fontsize="medium")
    axes[0, 1].legend(frameon=False, fontsize="x-small", loc="lower right")

    axes[0, 2].axvline(1.5, color="0.5", lw=0.8, ls=":")
    axes[0, 2].set(xscale="log", yscale="log", xlabel=r"segment / $\varepsilon$")
    axes[0, 2].set_ylabel("sawtooth of the force / its mean")
    axes[0, 2].set_title("unevenness from node to node", loc="left", fontsize="medium")
    axes[0, 2].legend(frameon=False, fontsize="x-small")

    for n, colour in zip((20, 40, 80, 160), COLOURS, strict=True):
        eps = RATIOS[1] * 0.5 / ASPECT
        place = (np.arange(n + 1) / n)[: n // 4 + 1]
        label = rf"segment = {1 / n / eps:.2g} $\varepsilon$"
        values = density(eps, n)[: len(place)]
        axes[1, 0].plot(place, values, "o-", ms=3, color=colour, label=label, lw=1)
    axes[1, 0].set(xlabel="from the end / length", ylabel="force per length / mean")
    axes[1, 0].set_xlim(-0.004, 0.15)
    axes[1, 0].set_title(r"rod across, $\varepsilon = 1.02\,r_0$", loc="left", fontsize="medium")
    axes[1, 0].legend(frameon=False, fontsize="x-small")

    for panel, quantity in zip(axes[1, 1:], ("v_x, mm/s", "head rate, rad/s"), strict=True):
        for mesh, colour in zip(sorted(set(robot["edge, mm"]))[::-1], COLOURS, strict=True):
            part = robot[robot["edge, mm"] == mesh]
            label = f"edges of {mesh:.3g} mm"
            panel.plot(
                part["eps / radius"], part[quantity].abs(), "o-", ms=4, color=colour, label=label
            )
        panel.axvline(ROOT_E, color="0.5", lw=0.8, ls=":")
        panel.set(xlabel=r"$\varepsilon / r_0$", ylabel=f"|{quantity}|".replace(", ", "|, ")[:-1])
        panel.set_title("robot at 60 rpm", loc="left", fontsize="medium")
    axes[1, 1].legend(frameon=False, fontsize="x-small")
    for panel in axes.flat:
        panel.grid(alpha=0.25)
    return fig


def main() -> None:
    arguments = command_line(__doc__).parse_args()
    rod, same, robot = rods(), equivalents(), robots()
    output = arguments.output
    everything = pd.concat([rod, same.assign(what="eps of a cylinder"), robot])
    everything.to_csv(output / "regularization.csv", index=False, float_format="%.6g")
    figures = ["along / cylinder", "across / cylinder", "along / spheroid", "across / spheroid"]
    formats = {"eps / radius": ".3f", "segments": "d", "segment / eps": ".3g"}
    formats |= dict.fromkeys(figures, ".3f") | {"sawtooth": ".2g"}
    robot_formats = {"edge, mm": ".3g", "eps / radius": ".3f", "segment / eps": ".3g"}
    robot_formats |= {"v_x, mm/s": ".4f", "head rate, rad/s": ".4f"}
    text = [
        "Drag of a straight rod, 50 times as long as thick, over that of a cylinder and of the "
        "spheroid inscribed in it. *Sawtooth*: how much the force per length of the rod that moves "
        "across goes up and down from one node to the next, over its mean.",
        markdown(rod, formats),
        "eps over the radius with which a rod in segments of some two eps has the drag of a "
        f"cylinder exactly; slender body theory has sqrt(e) = {ROOT_E:.3f}.",
        markdown(same, dict.fromkeys(same, ".3g")),
        "The robot with one flagellum at 60 rpm.",
        markdown(robot, robot_formats),
    ]
    whole = "\n\n".join(part.strip() for part in text) + "\n"
    (output / "regularization.md").write_text(whole, encoding="utf-8")
    figure(rod, robot).savefig(output / "regularization.png", dpi=150)
    print(whole)


if __name__ == "__main__":
    main()
