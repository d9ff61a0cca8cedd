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
# # From a scene to a calibration
#
# A robot swims in a viscous fluid by turning a soft helical flagellum. This notebook goes all the
# way that a researcher goes who has built such a robot and filmed it:
#
# 1. a **scene**: the robot, the fluid and the motor, in a text file;
# 2. **one step** of time: a single scalar, its gradient and its Hessian;
# 3. a **run**: the shape, the track of the head and its speed;
# 4. **derivatives** of the run, forward and backward, against finite differences;
# 5. a **calibration**: the drag of the head, from what a camera saw.
#
# Everything is in SI units.

# %%
# %matplotlib inline
import tempfile
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from IPython.display import display

import derjax as dj
from fitting import calibrate, load_dataset
from fitting.report import figure as fit_figure
from fitting.report import table as fit_table

dj.enable_compilation_cache()  # the second time this notebook does not wait for the compiler
plt.rcParams.update({"figure.dpi": 80, "axes.spines.top": False, "axes.spines.right": False})

# %% [markdown]
# ## 1. A scene
#
# A scene file says what the robot is and how it is simulated. What it leaves out has the value of
# the published robot; `derjax new` writes a complete, commented one. Here the rod is divided
# coarsely, so that everything is quick. A wrong key or a slip of units is an error that names it.

# %%
SCENE = """
[robot]
helix_radius = 6.4e-3
pitch = 44.5e-3
axial_length = 95.4e-3
rod_radius = 1.6e-3
edge_length = 10.0e-3

[material]
youngs_modulus = 1.255e6

[fluid]
viscosity = 1.0

[motor]
rpm = 60

[time]
step = 0.02
scheme = "trbdf2"
end = 5.0
inertia = false     # at such Reynolds numbers mass hardly counts

[solver]
tolerance = 1e-12   # far below what pictures need: we are going to compare derivatives
"""
path = Path(tempfile.mkdtemp()) / "scene.toml"
path.write_text(SCENE)
file = dj.load_scene(path)

# %% [markdown]
# `build` turns the file into a `Scene`, whose `start` is the robot at rest. The *terms* are
# the physical ingredients; one that a scene does not name is not in the compiled program.

# %%
scene = dj.build(file)
start, topology = scene.start, scene.rod.topology
print(scene)
print(f"{topology.n_nodes} nodes, {topology.n_edges} edges, {topology.n_dofs} degrees of freedom")

# %% [markdown]
# ## 2. One step: a scalar, its gradient, its Hessian
#
# The state one step later makes a scalar stationary, the incremental potential
#
# $$P(q_1) = E(q_1) + h\,\Phi\!\left(\frac{q_1 - q_0}{h};\, q_0 + \tfrac{h}{2} v_0\right)
#   + \frac{1}{2h^2}\left|q_1 - q_0 - h v_0\right|_M^2 - f \cdot q_1 ,$$
#
# with the elastic energy $E$, the dissipation $\Phi$ of the fluid, inertia, and dead loads $f$.
# Every term contributes its share. The motor works through $E$: by the end of the step it
# has turned the rod at its place by an angle, which bending and twisting are measured from.


# %%
@jax.jit
def expand(q, direction):
    """P, its gradient and Hessian as derjax assembles them, and what JAX alone makes of P."""
    potential = dj.potential(scene, start, scene.step_length)
    by_jax = jax.grad(potential.value)(q)
    along = jax.jvp(potential.gradient, (q,), (direction,))[1]
    return potential.value(q), potential.gradient(q), potential.hessian(q), by_jax, along


rng = np.random.default_rng(1)
scale = np.where(np.arange(topology.n_dofs) < 3 * topology.n_nodes, 3e-5, 1e-2)  # m, rad
q = start.q + scale * rng.standard_normal(topology.n_dofs)
direction = scale * rng.standard_normal(topology.n_dofs)
value, gradient, hessian, by_jax, along = expand(q, direction)


def deviation(a, b):
    """Largest difference, relative to the largest entry."""
    return float(jnp.abs(a - b).max() / jnp.abs(b).max())


print(f"P = {float(value):.6g} J")
print("assembled by derjax against what JAX makes of P:")
print(f"  gradient            {deviation(gradient, by_jax):.1e}")
print(f"  Hessian x direction {deviation(hessian @ direction, along):.1e}")
print(f"asymmetry of the Hessian: {deviation(hessian, hessian.T):.1e}")

# %% [markdown]
# The elements of the rod fill a band of the Hessian. The fluid couples every node of the
# flagellum with every other one: that is the full block. Along the Newton direction P falls at
# first, but so far from the solution its quadratic model does not hold for the whole step: hence
# the line search, which halves a step until P (or the largest force left) falls.

# %%
n_positions = 3 * topology.n_nodes
size = np.sqrt(np.abs(np.diag(hessian)))
scaled = np.log10(np.abs(hessian) / np.outer(size, size) + 1e-12)
figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.6), layout="constrained")
image = left.imshow(scaled, vmin=-6, vmax=0, cmap="viridis")
left.axhline(n_positions - 0.5, color="white", lw=0.8)
left.axvline(n_positions - 0.5, color="white", lw=0.8)
left.set(title="Hessian of one step", xlabel="degree of freedom", ylabel="degree of freedom")
figure.colorbar(image, ax=left, label=r"$\log_{10} |H_{ij}| / \sqrt{H_{ii} H_{jj}}$")

newton = -jnp.linalg.solve(hessian, gradient)
along_newton = np.linspace(-0.5, 2.5, 31)
values = jnp.stack([expand(q + s * newton, direction)[0] for s in along_newton])
quadratic = value + along_newton * (gradient @ newton) * (1 - along_newton / 2)
right.plot(along_newton, 1e6 * values, label="P")
right.plot(along_newton, 1e6 * quadratic, "--", label="its quadratic model")
right.axvline(1.0, color="grey", lw=0.8)
right.set(title="P along the Newton direction", xlabel="part of the Newton step", ylabel="P (µJ)")
right.legend(frameon=False)
display(figure)
plt.close(figure)

# %% [markdown]
# ## 3. A run
#
# `rollout` takes the steps, in one program that is compiled once. A step that fails never raises
# in compiled code: outside of it there is a warning, and `raise_if_failed` makes it an error. The
# red ball is the head, drawn to scale.

# %%
run = dj.rollout(scene)
run.raise_if_failed()
print(run)
display(run.plot("shape"))

# %%
display(run.plot("track"))

# %% [markdown]
# `run.to_dataset()` is the trajectory with labels and units (xarray), as `derjax simulate` writes
# it to a file, and `run.summary()` has the few numbers that a run is remembered by.

# %%
display(run.plot("speed"))
numbers = run.summary()
print(f"speed             {1e3 * numbers['v_x_m_per_s']:8.3f} mm/s along x")
print(f"rate of the head  {numbers['head_rate_rad_per_s']:8.3f} rad/s about its axis")
print(f"propulsive force  {1e3 * numbers['propulsive_force_N']:8.3f} mN along x")
print(f"efficiency        {numbers['efficiency']:8.3f}")

# %% [markdown]
# The left-handed helix and the positive motor rate push the robot towards -x, and the head turns
# against the flagellum.
#
# ## 4. Derivatives of a run
#
# `build` is a smooth function of the parameters of the file, and so is everything after it. Here
# are the displacement of the head along x and the angle that it has turned at the end of the run,
# and their derivatives with respect to the logarithms of six parameters: what a change by 1 % does.

# %%
NAMES = ("C_t", "C_r", "youngs_modulus", "viscosity", "pitch", "helix_radius")
nominal = jnp.log(jnp.array([file.parameters[name] for name in NAMES]))


@jax.jit
def swim(logarithms):
    """Displacement (m) and angle (rad) of the head at the end of the run."""
    run = dj.rollout(scene.replace(**dict(zip(NAMES, jnp.exp(logarithms), strict=True))))
    moved = run.head_position[-1, 0] - run.head_position[0, 0]
    return jnp.stack([moved, run.head_angle[-1]])


moved, turned = swim(nominal)
forward = jax.jit(jax.jacfwd(swim))(nominal)
reverse = jax.jit(jax.grad(lambda p: swim(p)[0]))(nominal)
print(f"moved {1e3 * float(moved):.4f} mm, turned {float(turned):.4f} rad")

# %% [markdown]
# Finite differences need two runs for every parameter, and the choice of a step: too long and the
# function is not straight, too short and round-off takes over. The exact derivatives need
# neither. Forward and reverse mode come from one rule (the implicit function theorem at the end
# of Newton's method) and agree to many more digits.

# %%
STEP = 1e-3
difference = jnp.stack(
    [
        (swim(nominal + step) - swim(nominal - step)) / (2 * STEP)
        for step in STEP * jnp.eye(len(NAMES))
    ],
    axis=1,
)
largest = jnp.abs(forward[0]).max()
table = pd.DataFrame(
    {
        "forward (mm)": 1e3 * forward[0],
        "reverse (mm)": 1e3 * reverse,
        "differences (mm)": 1e3 * difference[0],
        "forward - reverse (relative)": (forward[0] - reverse) / largest,
        "forward - differences (relative)": (forward[0] - difference[0]) / largest,
    },
    index=pd.Index(NAMES, name="dx / dlog"),
)
with pd.option_context("display.float_format", "{:.6g}".format):
    display(table)
assert deviation(forward[0], reverse) < 1e-8
assert deviation(forward, difference) < 1e-4

# %%
relative = np.asarray(forward) / np.array([[moved], [turned]])
figure, ax = plt.subplots(figsize=(7.0, 3.0), layout="constrained")
place = np.arange(len(NAMES))
ax.barh(place - 0.2, relative[0], 0.38, color="#1f5a82", label="displacement along x")
ax.barh(place + 0.2, relative[1], 0.38, color="#c1503a", label="angle of the head")
ax.axvline(0.0, color="black", lw=0.8)
ax.set_yticks(place, NAMES)
ax.invert_yaxis()
ax.set(xlabel="change (%) for 1 % more of the parameter", title="Sensitivities of the run")
ax.legend(frameon=False)
display(figure)
plt.close(figure)
print(f"E and viscosity together: {np.abs(relative[:, 2] + relative[:, 3]).max():.1e}")

# %% [markdown]
# The bars of Young's modulus and of the viscosity are equal and opposite. Without inertia the
# motion depends on their ratio only: **tracks fix ratios of forces and never their scale**. Fit
# one of the two, or neither, and measure the other.
#
# ## 5. Calibration
#
# The drag of the head is that of a sphere, times $C_t$ for translation and $C_r$ for
# rotation. Those two numbers stand for the true shape of the head and the walls of the tank, and
# are fitted to tracks. `data/camera` has tracks as a camera gives them: one frame per second, with
# noise of 0.1 mm and 0.02 rad. They were made from runs of an independent code with
# $C_t = 4.8$ and $C_r = 0.36$, so we know what should come out. To be quick we take
# the first 10 seconds of one run; the whole fit is `derjax fit data/camera/dataset.toml`.

# %%
root = next(p for p in [Path.cwd(), *Path.cwd().parents] if (p / "data" / "camera").is_dir())
dataset = load_dataset(root / "data" / "camera" / "dataset.toml")
track = next(one for one in dataset.runs if one.motor_rpm == 70)
early = track.time <= 10.0
track = replace(track, time=track.time[early], values=track.values[early])
print(f"start: C_t = {dataset.scene.head.C_t}, C_r = {dataset.scene.head.C_r}")

# %% [markdown]
# The code that the tracks are from resists the spin of the head about its axis only, so we
# ask for the same model. Then Gauss and Newton (with Levenberg's and Marquardt's help) do the rest:
# the simulation returns the residuals together with their exact derivatives, so a handful of
# runs is enough, where a search over a grid takes hundreds. The first of them are previews, which
# stop as soon as the robot swims steadily; we note where every iteration is.

# %%
content = dataset.scene.model_dump(exclude_unset=True)
content["head"] |= {"rotation": "spin"}
dataset = replace(dataset, scene=dj.SceneFile.model_validate(content), runs=(track,))
way = []


def note(progress):
    """Keep the parameters after every iteration."""
    if progress.latest is not None:
        way.append(list(progress.values.values()))


fit = calibrate(dataset, ["C_t", "C_r"], progress=note)
print(fit_table(fit))
print(fit.goodness.sentence())
print(f"correlation of the two: {fit.correlation[0, 1]:.2f}; {fit.status}")
print(f"noise found: {1e3 * fit.noise['position']:.3f} mm, {fit.noise['head_angle']:.4f} rad")

# %% [markdown]
# The intervals contain the truth, and the fit has found the noise of the camera, of which it
# was not told.

# %%
assert all(
    abs(fit.estimates[name].value - truth) < 4 * fit.estimates[name].std
    for name, truth in {"C_t": 4.8, "C_r": 0.36}.items()
)
figure = fit_figure(fit)
figure.set_dpi(80)
display(figure)

# %%
trail = np.array(way)
spread = np.array([estimate.std for estimate in fit.estimates.values()])
root_covariance = np.linalg.cholesky(fit.correlation * np.outer(spread, spread))
circle = np.linspace(0, 2 * np.pi, 100)
ellipse = trail[-1][:, None] + 2.45 * root_covariance @ [np.cos(circle), np.sin(circle)]
figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.4), layout="constrained")
left.plot(*trail.T, "o-", color="#1f5a82", ms=4, label="iterations")
left.set(title="Way of the fit")
right.plot(*trail[-1], "o", color="#1f5a82", ms=4, label="fit")
right.plot(*ellipse, color="#c1503a", label="95 % region")
right.set(title="Where it ends")
for ax in (left, right):
    ax.plot(4.8, 0.36, "k+", ms=12, label="truth")
    ax.set(xlabel="$C_t$ (dimensionless)", ylabel="$C_r$ (dimensionless)")
    ax.margins(x=0.05, y=0.2)
    ax.legend(frameon=False, loc="upper left", ncols=3)
display(figure)
plt.close(figure)

# %% [markdown]
# Error bars are about noise. A robot that differs from the model by some per cent gives parameters
# that differ as much, however small the bars: residuals that keep one sign for long, or are larger
# than the noise of the camera, tell. `calibrate` looks for that, says so in `fit.warnings`, makes
# the bars wider, and names what might be the cause (`fit.causes`).
