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
# # From a scene to gradients
#
# A robot swims in a viscous fluid by turning a soft helical flagellum. This notebook goes from its
# description in a file to exact derivatives of a run, in four parts:
#
# 1. a **scene**: the robot, the fluid and the motor, in a text file;
# 2. **one step** of time: a single scalar, its gradient and its Hessian;
# 3. a **run**: the shape, the track of the head and its speed;
# 4. **derivatives** of the run, forward and backward, against finite differences.
#
# Everything is in SI units.

# %%
# %matplotlib inline
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from IPython.display import display

import derjax as dj

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
end = 5.0
inertia = false     # at such Reynolds numbers mass hardly counts

[solver]
tolerance = 1e-12   # far below what pictures need: we are going to compare derivatives
"""
path = Path(tempfile.mkdtemp()) / "scene.toml"
path.write_text(SCENE)
file = dj.load_scene(path)

# %% [markdown]
# `build` turns the file into a `Scene`, whose `start` is the robot at rest. The *terms* are the
# physical ingredients; one that a scene does not name is not in the compiled program.

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
# Every term contributes its share. The motor works through $E$: by the end of the step it has
# turned the rod at its place by an angle, which bending and twisting are measured from.


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
# The elements of the rod fill a band of the Hessian. The fluid couples every node of the flagellum
# with every other one: that is the full block. Along the Newton direction P falls at first, but so
# far from the solution its quadratic model does not hold for the whole step: hence the line
# search, which halves a step until P (or the largest force left) falls.

# %% tags=["gallery"]
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
# and their derivatives with respect to the logarithms of six parameters: what a change by 1 %
# does.

# %%
NAMES = ("C_t", "C_r", "youngs_modulus", "viscosity", "pitch", "helix_radius")
nominal = jnp.log(jnp.array([file.parameters[name] for name in NAMES]))


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
# function is not straight, too short and round-off takes over. The exact derivatives need neither.
# Forward and reverse mode come from one rule (the implicit function theorem at the end of Newton's
# method) and agree to many more digits.

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
# motion depends on their ratio only: **tracks fix ratios of forces and never their scale**.
# Whoever calibrates a robot fits one of the two, or neither, and measures the other.

# %%
assert np.abs(relative[:, 2] + relative[:, 3]).max() < 1e-3

# %% [markdown]
# ## What to change
#
# - Another robot: `pitch = 31.8e-3`, `rpm = 100`, or `kind = "two_flagella"` in `[robot]`; `derjax
#   new` writes a scene file with every key explained.
# - `hydrodynamics = "rft"` in `[fluid]`: then the Hessian has no full block any more, and runs
#   take a fraction of the time.
# - Other names in `NAMES`: any number of `scene.parameters` will do. With many of them, reverse
#   mode is the one that stays cheap.
# - A longer `end`: do the derivatives grow, oscillate, or settle?
