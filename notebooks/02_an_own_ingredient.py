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
# # An ingredient of your own: a magnet in the head
#
# Robots of this kind are steered with magnets: one sits in the head, and coils around the tank
# make a field that turns it. derjax knows nothing of magnets, and this notebook adds one in three
# lines, checks that it does what a magnet should do, steers the robot with it, and differentiates
# where the robot ends by the strength of the magnet and the direction of the field.
#
# Everything is in SI units.

# %%
# %matplotlib inline
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
# ## 1. The robot
#
# It is that of the paper, divided coarsely and with local drag, so that everything is quick. The
# head resists rotation about all axes (`rotation = "full"`), as a sphere does. The first node of
# the rod is the centre of the head, and the first edge is its axis; the robot swims towards $-x$.

# %%
file = dj.robots.single_flagellum(
    edge_length=0.0125,
    rpm=60,
    fluid={"hydrodynamics": "rft"},
    head={"rotation": "full"},
    time={"step": 0.05, "end": 24.0, "frame": 0.4, "inertia": False},
    solver={"tolerance": 1e-11},  # derivatives are going to be compared
)
scene = dj.build(file)

# %% [markdown]
# ## 2. The magnet
#
# A dipole with the moment $m$ along the unit vector $n$ has the energy $-m\, n \cdot B$ in a field
# $B$. Here $n$ points forwards along the axis of the head, from the second node to the first. That
# is all derjax has to be told: forces are derivatives of the energy, and JAX finds them, as it
# finds the second derivatives that Newton's method asks for. What can be varied later is in
# `data`.


# %%
def compass(x, moment, field):
    """The energy (J) of a dipole (A m^2) along the axis of the head, in a field (T)."""
    axis = x[0] - x[1]
    return -moment * jnp.dot(field, axis) / jnp.linalg.norm(axis)


def with_magnet(scene, moment, field):
    """The scene with a magnet in the head."""
    return scene.with_term(dj.Energy(compass, nodes=[0, 1], data=(moment, field)))


# %% [markdown]
# The field has 5 mT, a hundred times that of the Earth, and is horizontal, at an angle from the
# direction in which the robot swims at first. A magnet of 0.1 cm³ of NdFeB has about 0.1 A m².

# %%
FIELD = 5e-3  # T
MOMENT = 0.01  # A m^2
ANGLE = np.radians(60.0)


def field_at(angle):
    """T, at an angle (rad) from -x towards +y."""
    return FIELD * jnp.stack([-jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)])


magnetic = with_magnet(scene, MOMENT, field_at(jnp.asarray(ANGLE)))
forces = np.asarray(dj.forces(magnetic, magnetic.start)["Energy"])
places = np.asarray(dj.positions(scene.rod.topology, scene.start.q))
torque = np.cross(places, forces).sum(axis=0)
dipole = MOMENT * np.array([-1.0, 0.0, 0.0])
expected = np.cross(dipole, np.asarray(magnetic[dj.Energy].data[1]))
print(f"sum of the forces  {np.abs(forces.sum(axis=0)).max():.1e} N")
print(f"torque about z     {torque[2]:.6e} N m; m x B: {expected[2]:.6e} N m")
np.testing.assert_allclose(forces.sum(axis=0), 0.0, atol=1e-15)
np.testing.assert_allclose(torque, expected, rtol=1e-9, atol=1e-15)

# %% [markdown]
# ## 3. A check against a closed form
#
# With a stiff flagellum and a motor that stands still, the robot is a rigid body that the field
# turns. Its angle $\psi$ obeys $\dot\psi = M\, m B \sin(\alpha - \psi)$, with the angle $\alpha$
# of the field, so that
#
# $$\tan\frac{\alpha - \psi}{2} = \tan\frac{\alpha}{2}\; e^{-M m B t} .$$
#
# The mobility $M$ comes from the resistance of the robot, which derjax computes as well. One
# function does everything from here on; it is compiled once.


# %%
@jax.jit
def swim(numbers):
    """Times (s), positions of all nodes (m) and how the steps went, with a magnet."""
    moment, angle, rpm, youngs_modulus = numbers
    changed = scene.replace(rpm=rpm, youngs_modulus=youngs_modulus)
    run = dj.rollout(with_magnet(changed, moment, field_at(angle)))
    return run.time, run.positions, run.stats


def heading(positions):
    """rad, of the head, from -x towards +y."""
    axis = np.asarray(positions[:, 0] - positions[:, 1])
    return np.unwrap(np.arctan2(axis[:, 1], -axis[:, 0]))


time, stiff, stats = swim(jnp.array([MOMENT, ANGLE, 0.0, 1e9]))
stats.raise_if_failed()
mobility = np.linalg.inv(dj.resistance(scene))[5, 5]  # rad/s for 1 N m about z
decay = np.exp(-mobility * MOMENT * FIELD * time)
closed = ANGLE - 2.0 * np.arctan(np.tan(ANGLE / 2.0) * decay)
error = np.abs(heading(stiff) - closed).max()
print(f"mobility {mobility:.1f} rad/(s N m), largest error {error:.1e} rad")
assert error < 1e-2 * ANGLE

# %% [markdown]
# ## 4. Steering
#
# Now the motor turns and the flagellum is soft. The stronger the magnet, the sooner the robot
# swims where the field points.

# %% tags=["gallery"]
MOMENTS = (0.0, 0.003, 0.01, 0.03)
tracks = {moment: swim(jnp.array([moment, ANGLE, 60.0, 1.255e6]))[1] for moment in MOMENTS}
colours = dict(zip(MOMENTS, plt.colormaps["viridis"](np.linspace(0.0, 0.85, 4)), strict=True))

figure, (left, right) = plt.subplots(1, 2, figsize=(10.0, 3.6), layout="constrained")
for moment, positions in tracks.items():
    moved = 1e3 * np.asarray(positions[:, 0] - positions[0, 0])
    label = f"{1e3 * moment:g} mA m²"
    left.plot(moved[:, 0], moved[:, 1], color=colours[moment])
    left.plot(*moved[-1, :2], "o", color=colours[moment], ms=4)
    right.plot(time, np.degrees(heading(positions)), color=colours[moment], label=label)
tail = np.array([-2.5, 6.0])
tip = tail + 4.0 * np.array([-np.cos(ANGLE), np.sin(ANGLE)])
left.annotate("", xy=tip, xytext=tail, arrowprops={"arrowstyle": "->", "color": "#c1503a"})
left.text(tip[0] + 1.3, tip[1] - 0.8, "field", color="#c1503a")
left.set(title="Tracks of the head, from above", xlabel="x (mm)", ylabel="y (mm)", aspect="equal")
right.plot(time, np.degrees(closed), "k:", lw=1.0, label="10 mA m², rigid,\nmotor at rest")
right.axhline(np.degrees(ANGLE), color="#c1503a", lw=0.8, label="field")
right.set(title="Heading", xlabel="time (s)", ylabel="angle (degrees)")
right.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
display(figure)
plt.close(figure)

# %% [markdown]
# A soft flagellum bends at first, so that the head runs ahead of the rest of the robot.

# %%
ends = {moment: float(np.degrees(heading(positions)[-1])) for moment, positions in tracks.items()}
for moment, end in ends.items():
    print(f"{1e3 * moment:4.0f} mA m²: heading {end:5.1f} degrees after {float(time[-1]):g} s")
assert list(ends.values()) == sorted(ends.values())
assert ends[0.0] < 2.0 < 40.0 < ends[0.03]

# %% [markdown]
# ## 5. Derivatives by what you have added
#
# `data` is differentiated like any other number of the scene. Here is where the head ends, $(x,
# y)$, by the logarithm of the moment and by the angle of the field: in forward mode, in reverse
# mode (for $y$) and as central differences.


# %%
def arrival(p):
    """Where the head ends (m), of the logarithm of the moment and the angle of the field."""
    positions = swim(jnp.stack([jnp.exp(p[0]), p[1], 60.0, 1.255e6]))[1]
    return positions[-1, 0, :2] - positions[0, 0, :2]


at = jnp.array([np.log(MOMENT), ANGLE])
forward = jax.jit(jax.jacfwd(arrival))(at)
reverse = jax.jit(jax.grad(lambda p: arrival(p)[1]))(at)
STEP = 1e-3
difference = jnp.stack(
    [(arrival(at + d) - arrival(at - d)) / (2 * STEP) for d in STEP * jnp.eye(2)], axis=1
)
table = pd.DataFrame(
    {
        "forward (mm)": 1e3 * forward[1],
        "reverse (mm)": 1e3 * reverse,
        "differences (mm)": 1e3 * difference[1],
    },
    index=pd.Index(["log of the moment", "angle of the field"], name="dy /"),
)
with pd.option_context("display.float_format", "{:.8g}".format):
    display(table)
np.testing.assert_allclose(reverse, forward[1], rtol=1e-8)
np.testing.assert_allclose(forward, difference, rtol=1e-4, atol=1e-4 * np.abs(forward).max())

# %% [markdown]
# What the derivative is good for: it says how far a stronger magnet would take the robot, without
# another run. The lines are tangents; the curve is made of runs.

# %%
strengths = np.geomspace(1e-3, 0.1, 9)
drift = 1e3 * np.array([arrival(jnp.array([np.log(m), ANGLE]))[1] for m in strengths])
figure, ax = plt.subplots(figsize=(6.0, 3.4), layout="constrained")
ax.plot(1e3 * strengths, drift, "o-", color="#1f5a82", ms=4, label="runs")
near = np.array([0.4, 2.5])
tangent = 1e3 * (arrival(at)[1] + forward[1, 0] * np.log(near))
ax.plot(1e3 * MOMENT * near, tangent, color="#c1503a", lw=2.0, label="exact derivative")
ax.set_xscale("log")
ax.set_xticks([1, 3, 10, 30, 100], ["1", "3", "10", "30", "100"])
ax.set(
    xlabel="magnetic moment (mA m²)",
    ylabel="y of the head after 24 s (mm)",
    title="How far the field takes the robot aside",
)
ax.legend(frameon=False)
display(figure)
plt.close(figure)

# %% [markdown]
# ## What to change
#
# - Another energy: `0.5 * stiffness * jnp.sum((x[0] - target) ** 2)` on `nodes=[-1]` is a trap
#   that holds the tip. Anything that can be written with `jax.numpy` and differentiated twice will
#   do.
# - A field that turns: give `compass` a place in a table of fields, or write a `dj.Term`, whose
#   `contribution` is told the time (`docs/add_an_ingredient.md`).
# - Which angle of the field makes the robot arrive somewhere? Put `arrival` and its derivatives
#   into any optimiser.
# - `hydrodynamics = "rss"` and a finer `edge_length` for numbers that are to be compared with
#   experiments.
