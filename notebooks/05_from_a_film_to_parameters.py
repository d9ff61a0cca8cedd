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
# # From a film to parameters
#
# A robot has been filmed, a tracker has found its head in every frame, and has written a table:
# numbers of frames, pixels, degrees. The drag of the head is that of a sphere, times $C_t$ for
# translation and $C_r$ for rotation; these two stand for the true shape of the head and the walls
# of the tank. This notebook goes from such tables to $C_t$ and $C_r$ with error bars, and asks
# whether the fit is to be trusted.
#
# So that we know what should come out, the films are made here: by a simulation with $C_t = 4.8$
# and $C_r = 0.36$, with the noise of a camera. With your own film, section 1 falls away.

# %%
# %matplotlib inline
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from IPython.display import display

import derjax as dj
from fitting import calibrate, load_dataset
from fitting.report import table as fit_table

dj.enable_compilation_cache()  # the second time this notebook does not wait for the compiler
plt.rcParams.update({"figure.dpi": 80, "axes.spines.top": False, "axes.spines.right": False})
BLUE, RED, GREY = "#1f5a82", "#c1503a", "#8a8f98"
folder = Path(tempfile.mkdtemp())

# %% [markdown]
# ## 1. Two films
#
# The scene file describes the robot as it was built. Its values of $C_t$ and $C_r$ are only where
# the fit will start. Mesh and drag are coarse here, so that all is quick.

# %%
SCENE = """
[robot]
helix_radius = 6.4e-3
pitch = 44.5e-3
axial_length = 95.4e-3
rod_radius = 1.6e-3
edge_length = 12.5e-3
head_radius = 31.0e-3

[material]
youngs_modulus = 1.255e6

[fluid]
viscosity = 1.0
hydrodynamics = "rft"

[head]
C_t = 3.0
C_r = 0.6

[time]
step = 0.02
frame = 0.5
end = 20.0
inertia = false
"""
(folder / "scene.toml").write_text(SCENE)
scene = dj.build(dj.load_scene(folder / "scene.toml"))
TRUTH = {"C_t": 4.8, "C_r": 0.36}

# %% [markdown]
# The camera looks from above and takes 30 frames per second, of which every 15th is tracked. A
# pixel is 0.15 mm, and $y$ points downwards in an image. A mark on the head shows its angle. There
# is a second object in the table, as trackers find more than they should, and some frames have no
# mark.

# %%
FPS, PIXEL = 30, 0.15e-3  # 1/s, m
NOISE_PIXEL, NOISE_DEGREES = 0.5, 1.0
rng = np.random.default_rng(5)


def film(rpm):
    """The table of a tracker."""
    run = dj.rollout(scene.replace(rpm=rpm, **TRUTH), reverse_mode=False)
    head, angle = np.asarray(run.head_position), np.degrees(run.head_angle)
    frame = np.round(FPS * np.asarray(run.time)).astype(int)
    n = len(frame)
    robot = pd.DataFrame(
        {
            "frame": frame,
            "track_id": 0,
            "X": 900.0 + head[:, 0] / PIXEL + NOISE_PIXEL * rng.normal(size=n),
            "Y": 240.0 - head[:, 1] / PIXEL + NOISE_PIXEL * rng.normal(size=n),
            "angle": angle + NOISE_DEGREES * rng.normal(size=n),
        }
    )
    robot.loc[rng.choice(n, 3, replace=False), "angle"] = np.nan
    speck = robot.assign(track_id=1, X=412.0, Y=88.0, angle=np.nan)
    return pd.concat([robot, speck]).sort_values(["frame", "track_id"])


RATES = (40, 80)
for rpm in RATES:
    film(rpm).to_csv(folder / f"film_{rpm}.csv", index=False, float_format="%.2f")
print((folder / "film_40.csv").read_text()[:240])

# %% [markdown]
# ## 2. What the columns mean
#
# A dataset file says which table belongs to which motor rate, and what is in its columns. `derjax
# new` writes one in which every option is explained. What does not fit together, such as a column
# that is not there or several objects in a table, is an error that names file and column.

# %%
RUN = """
[[runs]]
track = "film_{rpm}.csv"
motor_rpm = {rpm}
columns = {{ t = "frame", x = "X", y = "-Y", head_angle = "angle" }}
track_id = 0         # there are two objects in the table
fps = 30             # t holds numbers of frames
pixel_size = 0.15    # of x and y, in length_unit
length_unit = "mm"
angle_unit = "deg"
origin = "track"     # only displacements count
"""
(folder / "dataset.toml").write_text(
    'scene = "scene.toml"\n' + "".join(RUN.format(rpm=rpm) for rpm in RATES)
)
dataset = load_dataset(folder / "dataset.toml")
for run in dataset.runs:
    print(f"{run.name}: {len(run.time)} frames to {run.time[-1]:g} s, {run.dropped} left out")

# %% [markdown]
# ## 3. The fit
#
# The simulation returns residuals together with their exact derivatives, so that a handful of
# simulations is enough. It is told nothing about the noise, and estimates it. On the command line
# the same is `derjax fit dataset.toml -o fit`.

# %%
fit = calibrate(dataset, ["C_t", "C_r"])
print(fit_table(fit))
print(fit.goodness.sentence())
print(f"{fit.status} after {fit.previews} previews and {fit.simulations} whole simulations")
noise = fit.noise["position"] / PIXEL, np.degrees(fit.noise["head_angle"])
print(f"noise found: {noise[0]:.2f} pixels, {noise[1]:.2f} degrees")

# %% [markdown]
# The intervals hold the truth, and the noise is that of the camera.

# %%
for name, truth in TRUTH.items():
    assert abs(fit.estimates[name].value - truth) < 4 * fit.estimates[name].std, name
assert fit.status == "converged"
assert fit.goodness.good
np.testing.assert_allclose(noise, [NOISE_PIXEL, NOISE_DEGREES], rtol=0.25)

# %% [markdown]
# ## 4. Is it to be trusted?
#
# Look at the residuals. If they are noise, they scatter around zero without order. If they keep
# one sign for long, or are larger than what the camera does, the model is wrong somewhere;
# `fit.goodness` looks for that, `fit.warnings` says so and `fit.causes` names what might be the
# cause.

# %% tags=["gallery"]
figure, axes = plt.subplots(2, 3, figsize=(11.0, 5.0), layout="constrained", sharex=True)
for one, colour in zip(fit.runs, (BLUE, RED), strict=True):
    track, after, before = one.run, one.after, one.before
    for ax, below, channel, scale in zip(axes[0], axes[1], (0, 1, 3), (1e3, 1e3, 1.0), strict=True):
        place = track.channels.index(channel)
        shift = after.observed[0, channel] if channel < 3 else 0.0
        seen = scale * (np.interp(track.time, after.time, after.observed[:, channel]) - shift)
        residual = scale * one.residuals[:, place]
        start = scale * (before.observed[:, channel] - before.observed[0, channel])
        ax.plot(before.time, start, ":", color=colour, lw=1.2)
        ax.plot(track.time, seen, color=colour, label=f"{track.motor_rpm:g} rpm")
        ax.plot(track.time, seen - residual, "o", color=colour, ms=3, mfc="none")
        below.plot(track.time, residual, "o-", color=colour, ms=3, lw=0.6)
for ax, label in zip(axes[0], ("x moved (mm)", "y moved (mm)", "head angle (rad)"), strict=True):
    ax.set_ylabel(label)
for ax, label in zip(axes[1], ("x (mm)", "y (mm)", "angle (rad)"), strict=True):
    ax.axhline(0.0, color=GREY, lw=0.8)
    ax.set(ylabel=f"residual in {label}", xlabel="time (s)")
axes[0, 0].legend(frameon=False)
display(figure)
plt.close(figure)

# %% [markdown]
# Circles are the tracks, lines the simulation after the fit, and dotted lines before it. Errors of
# the two parameters, and how they are correlated:

# %%
names = list(fit.estimates)
spread = np.array([fit.estimates[name].std for name in names])
best = np.array([fit.estimates[name].value for name in names])
root = np.linalg.cholesky(fit.correlation * np.outer(spread, spread))
circle = np.linspace(0.0, 2 * np.pi, 100)
ellipse = best[:, None] + 2.45 * root @ [np.cos(circle), np.sin(circle)]
print(f"correlation of the two: {fit.correlation[0, 1]:.2f}")
figure, ax = plt.subplots(figsize=(4.6, 3.4), layout="constrained")
ax.plot(*ellipse, color=RED, label="95 % region")
ax.plot(*best, "o", color=BLUE, label="fit")
ax.plot(TRUTH["C_t"], TRUTH["C_r"], "k+", ms=12, label="truth")
ax.set(xlabel="$C_t$ (dimensionless)", ylabel="$C_r$ (dimensionless)")
ax.margins(0.25)
ax.legend(frameon=False, fontsize=8)
display(figure)
plt.close(figure)
assert abs(fit.correlation[0, 1]) < 0.5

# %% [markdown]
# The two are hardly correlated: the speed of the robot tells $C_t$, and the rate of its head
# $C_r$. From one of them alone one could not have both.
#
# Error bars are about noise only. A robot that differs from the model by some per cent gives
# parameters that differ as much, however small the bars: a finer mesh, `hydrodynamics = "rss"` and
# measured values of the material and the fluid matter more than more frames.
#
# ## What to change
#
# For a film of your own:
#
# - `scene.toml`: the robot that you built, in metres; start `C_t` and `C_r` at 1; no `edge_length`
#   and no `hydrodynamics`, whose defaults are what fits should use.
# - `dataset.toml`: one `[[runs]]` for each film, with the names of your columns, `fps`,
#   `pixel_size` and the rate of the motor. Leave out `head_angle` if you have none.
# - `sigma` and `sigma_angle`, if you know the noise: then the fit also says whether it is as large
#   as it should be.
# - A motor that does not turn steadily: `[motor] table` in the scene. A tank that flows: `drift =
#   true`.
#
# To see what a fit says when something is wrong, write `x = "-X"`, or another `motor_rpm` for one
# of the films, and print `fit.warnings` and `fit.causes`.
