# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3 (ipykernel)
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Two flagella that bundle: phases and friction
#
# Two soft helices that turn side by side pull each other together through the fluid, wind about
# each other and touch. This notebook simulates the robot with two flagella four times, with the
# flagella in phase and in antiphase, with and without friction where they touch, and compares how
# close they come, how they wind, and how the robot swims.
#
# Everything is in SI units.

# %%
# %matplotlib inline
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from IPython.display import display
from scipy.interpolate import CubicSpline

import derjax as dj

dj.enable_compilation_cache()  # the second time this notebook does not wait for the compiler
plt.rcParams.update({"figure.dpi": 80, "axes.spines.top": False, "axes.spines.right": False})
BLUE, RED = "#1f5a82", "#c1503a"

# %% [markdown]
# ## 1. Four robots
#
# Here the flow that each part of a flagellum makes at all others counts (`hydrodynamics = "rss"`):
# without it, flagella do not know of each other before they touch. The mesh is coarse, with edges
# of 12.5 mm, so that a run takes seconds, and contact is stiffer than by default, as long edges
# that cross need it.
#
# `phase` is the direction in which each flagellum leaves its axis at the start, the same in space
# for both. Both are left-handed and both motors turn alike. Friction is Coulomb's. A coefficient
# of 0 would leave it out of the program altogether; "without" is a coefficient of one in a million
# here, so that all four runs share one compiled program.

# %%
DIAMETER = 3.2e-3  # m, of the rods
FRICTION, NONE = 0.5, 1e-6


def robot(phases, coefficient):
    """Two flagella with phases (rad) at the start, and a coefficient of friction."""
    return dj.build(
        dj.robots.two_flagella(
            pitch=0.0318,
            rpm=60,
            phase=phases,
            edge_length=0.0125,
            contact={"stiffness": 8e3},
            friction={"coefficient": coefficient},
            time={"inertia": False, "end": 11.0, "frame": 0.1},
        )
    )


CASES = {
    "in phase": ([0.0, 0.0], NONE),
    "in phase, friction": ([0.0, 0.0], FRICTION),
    "antiphase": ([0.0, np.pi], NONE),
    "antiphase, friction": ([0.0, np.pi], FRICTION),
}
runs = {name: dj.rollout(robot(*case), reverse_mode=False) for name, case in CASES.items()}
for name, run in runs.items():
    run.raise_if_failed()
    print(f"{name:20} {int(run.stats.steps)} steps of time")

# %% [markdown]
# `to_dataset` gives trajectories with what belongs to several flagella: their smallest distance,
# the part of them that is bundled, and Gauss' linking number, which says how often they wind about
# each other.

# %%
TURN = 10  # frames in a turn of the motors
data = {name: run.to_dataset() for name, run in runs.items()}
mean = {name: one.rolling(time=TURN, center=True).mean() for name, one in data.items()}
figure, axes = plt.subplots(1, 3, figsize=(10.5, 3.3), layout="constrained")
for name, one in data.items():
    style = {
        "color": BLUE if name.startswith("in phase") else RED,
        "ls": "--" if name.endswith("friction") else "-",
        "label": name,
    }
    axes[0].plot(one.time, one.minimum_distance / DIAMETER, **style)
    axes[1].plot(one.time, 100 * mean[name].bundle_fraction, **style)
    axes[2].plot(one.time, mean[name].linking_number, **style)
axes[0].axhline(1.0, color="black", lw=0.8, ls=":")
axes[0].set(
    title="Smallest distance", ylabel="distance of centre lines (diameters)", ylim=(0, None)
)
axes[1].set(title="Bundled part", ylabel="within two diameters (%)")
axes[2].set(title="Winding", ylabel="linking number (turns)")
for ax in axes:
    ax.set_xlabel("time (s)")
axes[0].legend(frameon=False)
display(figure)
plt.close(figure)

# %% [markdown]
# The dotted line is contact: distances of centre lines stay at one diameter, as rods do not pass
# through each other.

# %%
for name, one in data.items():
    distance = one.minimum_distance.values / DIAMETER
    assert distance.min() > 0.99, name  # no overlap beyond 1 % of the diameter
    assert distance[0] > 4.0, name
    assert distance[one.time > 8.0].max() < 1.25, name  # they stay together
    assert one.bundle_fraction[-1] > 0.2, name

# %% [markdown]
# ## 2. What they look like
#
# Here are the robots at the end, seen obliquely from above, to scale and with what is in front
# drawn in front.


# %%
def draw(ax, run):
    """The flagella at the end of a run, smooth between nodes, in mm."""
    nodes = 1e3 * np.asarray(run.positions[-1])
    up = np.radians(25.0)
    view = np.array([[1, 0, 0], [0, np.sin(up), np.cos(up)], [0, -np.cos(up), np.sin(up)]])
    pieces = []
    for path, colour in zip(run.scene.rod.topology.filaments, (BLUE, RED), strict=True):
        places = nodes[list(path)] @ view.T
        fine = CubicSpline(np.arange(len(places)), places)(np.linspace(0, len(places) - 1, 121))
        pieces += [(piece[:, 2].mean(), piece, colour) for piece in cut(fine)]
    for _, piece, colour in sorted(pieces, key=lambda each: each[0]):
        ax.plot(*piece[:, :2].T, color="white", lw=9.5, solid_capstyle="butt")
        ax.plot(*piece[:, :2].T, color=colour, lw=7.5, solid_capstyle="round")
    ax.set(aspect="equal", xlim=(-25, 112), ylim=(-32, 32))
    ax.set_axis_off()


def cut(points):
    """Overlapping pieces of a curve, of four points each."""
    return [points[k : k + 4] for k in range(0, len(points) - 3, 3)]


figure, axes = plt.subplots(2, 2, figsize=(10.0, 4.6), layout="constrained")
for ax, (name, run) in zip(axes.flat, runs.items(), strict=True):
    draw(ax, run)
    ax.set_title(name)
axes[1, 0].plot([-20, 0], [-26, -26], color="black", lw=2.0)
axes[1, 0].text(-10, -24, "20 mm", ha="center", va="bottom")
display(figure)
plt.close(figure)

# %% [markdown]
# ## 3. What it is worth
#
# Means over the last four turns: the speed of the head, how fast it turns, and how flagella are
# wound.

# %%
LAST = 4 * TURN
rows = {}
for name, one in data.items():
    late = one.isel(time=slice(-LAST - 1, None))
    time = late.time.values
    rows[name] = {
        "speed (mm/s)": -1e3 * np.polyfit(time, late.head_position.values[:, 0], 1)[0],
        "aside (mm)": 1e3 * np.linalg.norm(late.head_position.values[-1, 1:]),
        "head rate (rad/s)": np.polyfit(time, late.head_angle.values, 1)[0],
        "bundled (%)": 100 * late.bundle_fraction.values[1:].mean(),
        "linking number": late.linking_number.values[1:].mean(),
    }
table = pd.DataFrame(rows).T
with pd.option_context("display.float_format", "{:.3f}".format):
    display(table)

# %% [markdown]
# In antiphase, the robot is symmetric under half a turn about its axis, and stays so: the head
# keeps to the axis to round-off. In phase it is not, and the head wanders a little.

# %%
assert table["aside (mm)"]["antiphase"] < 1e-3 < table["aside (mm)"]["in phase"]
assert table["linking number"]["in phase, friction"] > table["linking number"]["in phase"] + 0.05
assert table["linking number"].between(0.4, 1.0).all()

# %% [markdown]
# ## What to change
#
# - `rpm`: below some rate the flagella do not touch; at 100 they wind about each other for more
#   than a turn, and need a finer mesh.
# - `handedness=["left", "right"]` and `rpm=[60, -60]`: mirror images that turn against each other.
# - `phase=[0, 1.57]`, or motors that differ a little: `rpm=[60, 61]`.
# - A finer `edge_length` and the default stiffness of contact for numbers that are to be compared
#   with experiments.
# - `runs["antiphase"].film("bundle.html")` writes a page in which the robot can be turned.
