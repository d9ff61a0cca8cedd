"""TR-BDF2: the trapezoidal rule, then a backward difference, as a Runge-Kutta method of order two.

With d = 1 - 1/sqrt(2), w = sqrt(2)/4 and dy/dt = f(t, y) a step from y0, where f is f0, goes

    y1 = y0 + d h (f0 + f1)               at t0 + 2 d h,
    y2 = y0 + w h (f0 + f1) + d h f2      at t0 + h,

and ends at y2. Its f2 is the f0 of the next step. It is L-stable (Bank et al., IEEE Trans.
Electron Devices 32, 1992, 1985; Hosea & Shampine, Appl. Numer. Math. 20, 21, 1996). Here y is
positions and velocities together; each stage is one of implicit Euler of length d h.

Nothing is known of f0 before the first step: a motor sets a rod without inertia going at once.
That step is one of the method of Alexander (SIAM J. Numer. Anal. 14, 1006, 1977) with the same d,

    y1 = y0 + d h f1  at t0 + d h,        y2 = y0 + (1 - d) h f1 + d h f2  at t0 + h,

which has the same order and the same amplification factor.
"""

import math

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ...core.pytree import pytree
from ...rods.rod import State
from ...solve.contributions import Dofs
from ...solve.newton import NewtonInfo, worse
from ...terms.term import Stage
from ..predictor import has_moved, jerk
from ..step import (
    Scene,
    Step,
    finish_step,
    fluid_velocity,
    motor_angle,
    motor_rotation,
    predict,
    predicted_displacement,
    solve,
)

D = 1.0 - 1.0 / math.sqrt(2.0)
W = 0.25 * math.sqrt(2.0)

ERROR = 2.0 * D**3 - 3.0 * D**2 + 1.0 / 6.0
"""A step adds ERROR h^3 d3y/dt3 to the error of a solution of y' = lambda y."""


FIRST = np.array([[D, 0.0, 0.0], [1.0, 0.0, 1.0 - D]])
"""The stages of the first step of a run, in units of h: where each ends, and how much of f0 and
of the f1 before it is in its origin."""

LATER = np.array([[2.0 * D, D, 0.0], [1.0, W, W]])
"""Those of every other step."""


@pytree
class _End:
    """What is found at the end of a stage.

    Attributes:
        q: (d,) m and rad.
        velocity: (d,) m/s and rad/s.
        acceleration: (d,) m/s^2 and rad/s^2.
        surprise: (d,) m and rad, by how much it is off from where it was expected.
        motor_angle: (k,) rad.
        motor_rate: (k,) rad/s.
    """

    q: Dofs
    velocity: Dofs
    acceleration: Dofs
    surprise: Dofs
    motor_angle: Array
    motor_rate: Array


def trbdf2(scene: Scene, state: State, length: Array) -> Step:
    """A step of some length (s), differentiable in forward and reverse mode.

    Drag matrices are taken where the rod is expected at the end of each stage, as f0 has to be
    that of the end of a step.
    """
    part = D * length

    def stage(carry, coefficients):
        before, info = carry
        end, known, found = coefficients * length
        origin = state.q + known * state.velocity + found * before.velocity
        pace = state.velocity + known * state.acceleration + found * before.acceleration
        shafts = state.motor_angle + known * state.motor_rate + found * before.motor_rate
        turn = motor_rotation(scene, state, end)
        expected = predicted_displacement(scene, state, end)
        # An unexpected velocity was felt over `part` before, and is over `found` as well by now.
        move = expected + (found + part) / part * before.surprise
        prediction = predict(scene, state, end, end)
        flow = fluid_velocity(scene, prediction.configuration, state.time + end)
        angle = state.motor_angle + turn
        solved = Stage(part, state.time + end, angle, origin, pace, flow, shafts)
        q, how = solve(scene, prediction, state, solved, turn, move)
        angle = motor_angle(scene, state, solved, prediction, q)
        velocity = (q - origin) / part
        acceleration = (velocity - pace) / part
        surprise, rate = q - state.q - expected, (angle - shafts) / part
        return (_End(q, velocity, acceleration, surprise, angle, rate), worse(info, how)), None

    # One loop rather than the same program twice: half as long to compile.
    still = jnp.zeros_like(state.q)
    count = jnp.zeros((), jnp.int32)
    shafts = state.motor_angle, jnp.zeros_like(state.motor_rate)
    start = (
        _End(state.q, still, still, still, *shafts),
        NewtonInfo(count, count, count, jnp.zeros(())),
    )
    stages = jnp.where(has_moved(state), LATER, FIRST)
    (last, info), _ = lax.scan(stage, start, stages)
    error = ERROR * length**3 * jerk(state, length, last.q)
    shafts = last.motor_angle, last.motor_rate
    end = finish_step(scene, state, length, last.q, last.velocity, last.acceleration, *shafts)
    return Step(end, info, error)
