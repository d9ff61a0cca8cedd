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
# # Steady swimming, and where it buckles
#
# A robot that swims steadily keeps its shape: it moves and turns as a whole. Such a state need not
# be waited for, it can be solved for. This notebook
#
# 1. finds **steady swimming** at one rate of the motor, and over many;
# 2. asks whether it is **stable**: how fast do small deviations grow or decay?
# 3. finds the **threshold**, the rate at which the flagellum buckles, and its exact derivatives;
# 4. looks on both sides of it with **simulations in time**.
#
# Everything is in SI units, motor rates in revolutions per minute.

# %%
# %matplotlib inline
from dataclasses import replace

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from IPython.display import display
from scipy.interpolate import CubicSpline

import derjax as dj

dj.enable_compilation_cache()  # the second time this notebook does not wait for the compiler
plt.rcParams.update({"figure.dpi": 80, "axes.spines.top": False, "axes.spines.right": False})
BLUE, RED, GREY = "#1f5a82", "#c1503a", "#8a8f98"

# %% [markdown]
# ## 1. Steady swimming
#
# The robot has a flagellum of five radii of pitch, is divided coarsely and has local drag, so that
# everything is quick. `dj.steady` solves for the shape and its motion.

# %%
file = dj.robots.single_flagellum(
    pitch=0.0318,
    rpm=100,
    edge_length=0.0125,
    fluid={"hydrodynamics": "rft"},
    time={"inertia": False, "end": 44.0, "frame": 0.04},
)
scene = dj.build(file)
state = dj.steady(scene)
state.raise_if_failed()
print(f"speed along the axis     {1e3 * float(state.speed):7.4f} mm/s")
print(f"rate of the head         {float(state.head_rate):7.4f} rad/s")
print(f"from head to tail        {1e3 * float(state.tail_to_head):7.2f} mm")
assert state.ok

# %% [markdown]
# `dj.steady_curve` goes over many values of a number, here the rate of the motor, and looks for
# each state where those before it point to. Of each we ask how fast the leading mode grows: a
# small deviation goes as $e^{\lambda t}$, and the steady state is stable if the real part of every
# $\lambda$ is negative.

# %%
rates = np.arange(20.0, 321.0, 20.0)
curve = list(dj.steady_curve(scene, "rpm", rates))
modes = [dj.stability(one) for one in curve]
growth = np.array([mode.growth_rate for mode in modes])
speed = np.array([1e3 * float(one.speed) for one in curve])
assert all(one.ok for one in curve)
assert np.all(np.diff(growth) > 0)

# %% [markdown]
# ## 2. The threshold
#
# `dj.threshold` finds the rate at which the growth rate vanishes, to round-off.

# %%
limit = dj.threshold(scene, "rpm", start=200.0)
print(f"steady swimming loses its stability at {limit.value:.4f} rpm")
print(f"growth rate there                      {limit.stability.growth_rate:.1e} 1/s")
print(f"frequency, seen from the flagellum     {limit.stability.frequency:.3f} 1/s")
print(f"frequency, seen from the laboratory    {limit.stability.laboratory_frequency:.4f} 1/s")
assert abs(limit.stability.growth_rate) < 1e-6
assert abs(np.interp(0.0, growth, rates) - limit.value) < 5.0

# %% [markdown]
# Seen from the laboratory the deviation hardly moves: the flagellum turns inside of a bend that
# stays where it is. That is buckling, and dimensions say how its rate depends on the stiffness: as
# $E / \mu$.

# %%
stable = rates <= limit.value
figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.4), layout="constrained")
at_limit = 1e3 * float(limit.stability.state.speed)
for ax, values, there in ((left, -speed, -at_limit), (right, growth, 0.0)):
    ax.plot([*rates[stable], limit.value], [*values[stable], there], color=BLUE, label="stable")
    ax.plot(
        [limit.value, *rates[~stable]],
        [there, *values[~stable]],
        "--",
        color=BLUE,
        label="unstable",
    )
    ax.plot(limit.value, there, "o", color=RED, label="threshold")
    ax.set_xlabel("rate of the motor (rpm)")
right.axhline(0.0, color=GREY, lw=0.8)
left.set(title="Steady swimming", ylabel="speed (mm/s)")
right.set(title="Its leading mode", ylabel="growth rate (1/s)")
left.legend(frameon=False)
display(figure)
plt.close(figure)

# %% [markdown]
# ## 3. What moves the threshold
#
# The threshold has exact derivatives by every other number of the scene, from perturbation theory:
# what a change by 1 % of the pitch, or of Young's modulus, does to it. That by Young's modulus
# must be 1 % by dimensions.

# %%
slopes = limit.derivatives(["pitch", "youngs_modulus"])
relative = {name: slope * scene.number(name) / limit.value for name, slope in slopes.items()}
for name, value in relative.items():
    print(f"1 % more of {name:15} moves the threshold by {value:.6f} %")
assert abs(relative["youngs_modulus"] - 1.0) < 1e-6

# %% [markdown]
# The threshold at other pitches, each found by itself, for comparison:

# %%
pitches = np.array([0.026, 0.029, 0.0318, 0.035, 0.038, 0.0415, 0.0445])
thresholds = [dj.threshold(scene.replace(pitch=p), "rpm", start=limit.value).value for p in pitches]
step = 1e-5
above, below = (
    dj.threshold(scene.replace(pitch=0.0318 + s), "rpm", start=limit.value).value
    for s in (step, -step)
)
difference = (above - below) / (2 * step)
print(f"by the pitch: exact {slopes['pitch']:.4f} rpm/m, central difference {difference:.4f} rpm/m")
assert abs(slopes["pitch"] - difference) < 1e-4 * abs(difference)

figure, ax = plt.subplots(figsize=(6.0, 3.4), layout="constrained")
ax.plot(1e3 * pitches, thresholds, "o-", color=BLUE, ms=4, label="threshold")
near = 0.0318 + np.array([-5e-3, 5e-3])
tangent = limit.value + slopes["pitch"] * (near - 0.0318)
ax.plot(1e3 * near, tangent, color=RED, lw=2.0, label="exact derivative")
ax.set(xlabel="pitch (mm)", ylabel="motor rate (rpm)", title="Where steady swimming buckles")
ax.legend(frameon=False)
display(figure)
plt.close(figure)

# %% [markdown]
# ## 4. In time
#
# Now the robot is simulated at 10 % below and at 10 % above the threshold, from its steady state,
# displaced a little along the leading mode. To see the bend we take the direction of the head and
# that from the second to the last node, and average both over a turn of the shape: what goes round
# with the flagellum cancels, and what stays where it is remains. The bend is the angle between the
# two.


# %%
def bend(run, turn):
    """Times (s), and the angle (rad) between head and flagellum, both averaged over a turn (s)."""
    nodes, time = np.asarray(run.positions), np.asarray(run.time)
    middle = time[(time > turn / 2) & (time < time[-1] - turn / 2)]
    at = middle[:, None] + turn * (np.arange(64) / 64 - 0.5)

    def averaged(vector):
        return np.stack([np.interp(at, time, part).mean(axis=1) for part in vector.T], axis=1)

    head, flagellum = averaged(nodes[:, 1] - nodes[:, 0]), averaged(nodes[:, -1] - nodes[:, 1])
    sine = np.linalg.norm(np.cross(head, flagellum), axis=1)
    return middle, np.arctan2(sine, np.sum(head * flagellum, axis=1))


def simulate(part):
    """At a part of the threshold: the modes of the steady state, and a run that starts near it."""
    modes = dj.stability(dj.steady(scene.replace(rpm=part * limit.value)))
    mode = modes.modes[0].real
    begin = modes.state.state
    begin = replace(begin, q=begin.q + 1e-3 * jnp.asarray(mode / np.abs(mode).max()))
    run = dj.rollout(modes.state.scene, state=begin, reverse_mode=False)
    run.raise_if_failed()
    return modes, run


runs = {part: simulate(part) for part in (0.9, 1.1)}

# %% [markdown]
# The dotted lines have the slopes that the eigenvalues say.

# %%
figure, ax = plt.subplots(figsize=(6.5, 3.4), layout="constrained")
measured = {}
for (part, (modes, run)), colour in zip(runs.items(), (BLUE, RED), strict=True):
    turning = float(np.linalg.norm(modes.state.motion.rotation))
    time, angle = bend(run, 2 * np.pi / turning)
    ax.plot(time, np.degrees(angle), color=colour, label=f"{part:g} of the threshold")
    early = (time > 1.0) & (time < 9.0)
    measured[part] = np.polyfit(time[early], np.log(angle[early]), 1)[0]
    line = np.exp(modes.growth_rate * (time - 5.0)) * np.interp(5.0, time, angle)
    shown = time < 10.0 if part < 1 else time < 24.0
    ax.plot(time[shown], np.degrees(line[shown]), "k:", lw=1.2)
    print(f"{part:g} of the threshold: growth rate {modes.growth_rate:.4f} 1/s, ", end="")
    print(f"in the simulation {measured[part]:.4f} 1/s")
ax.plot([], [], "k:", lw=1.2, label="its growth rate")
ax.set(yscale="log", ylim=(0.01, 100.0), xlabel="time (s)", ylabel="bend (degrees)")
ax.set_title("Below and above the threshold")
ax.legend(frameon=False)
display(figure)
plt.close(figure)
assert all(abs(measured[part] - modes.growth_rate) < 0.02 for part, (modes, _) in runs.items())

# %% [markdown]
# Beyond the threshold the bend grows until the flagellum is so different from its steady shape
# that other forces hold it. Here are the shapes of the last turn of both runs, one of them in
# colour, from the side to which the flagellum is bent. They are drawn smoothly between nodes.


# %%
def seen(run, turn):
    """Shapes (t, n, 2) of the last turn (s), m from the head: along it, and across."""
    last = np.asarray(run.time) > float(run.time[-1]) - turn
    nodes = np.asarray(run.positions)[last]
    nodes = nodes - nodes[:, :1]
    along = nodes[:, 1].mean(axis=0)
    along /= np.linalg.norm(along)
    chord = (nodes[:, -1] - nodes[:, 1]).mean(axis=0)
    across = chord - (chord @ along) * along
    return np.stack([nodes @ along, nodes @ across / np.linalg.norm(across)], axis=-1)


figure, axes = plt.subplots(1, 2, figsize=(9.0, 3.0), sharey=True, layout="constrained")
for ax, (part, (modes, run)), colour in zip(axes, runs.items(), (BLUE, RED), strict=True):
    shapes = 1e3 * seen(run, 2 * np.pi / float(np.linalg.norm(modes.state.motion.rotation)))
    fine = np.linspace(0, shapes.shape[1] - 1, 200)
    for k, shape in enumerate(CubicSpline(np.arange(shapes.shape[1]), shapes, axis=1)(fine)):
        last = k == len(shapes) - 1
        ax.plot(*shape.T, color=colour if last else "#c9ccd2", lw=2.5 if last else 1.0)
    ax.add_patch(plt.Circle((0.0, 0.0), 31.0, color="#d9dbe0", zorder=3))
    ax.set(title=f"{part:g} of the threshold", xlabel="along the head (mm)", aspect="equal")
axes[0].set_ylabel("across (mm)")
display(figure)
plt.close(figure)
bent = {}
for part, (modes, run) in runs.items():
    turn = 2 * np.pi / float(np.linalg.norm(modes.state.motion.rotation))
    bent[part] = float(np.degrees(bend(run, turn)[1][-1]))
    print(f"{part:g} of the threshold: bent by {bent[part]:.2g} degrees at the end")
assert bent[0.9] < 0.1 < 5.0 < bent[1.1]

# %% [markdown]
# ## What to change
#
# - `hydrodynamics = "rss"` and a finer `edge_length`: the thresholds of the paper's model
#   (`docs/steady.md` has them).
# - Another number instead of `"rpm"` in `dj.steady_curve` and `dj.threshold`: `"youngs_modulus"`,
#   `"viscosity"`, `"axial_length"`.
# - More names in `limit.derivatives`: they cost nothing more to compile.
# - 1.3 instead of 1.1 times the threshold: how far does the bend grow?
# - `dj.branch` follows steady states around folds; several flagella have periodic orbits,
#   `dj.orbit`.
