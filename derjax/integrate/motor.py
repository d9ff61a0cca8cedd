"""Motors of prescribed rates: how far their shafts have turned."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core.pytree import pytree
from ..rods.rod import Rod, State
from ..terms.term import Prediction, Stage


@pytree
class Motor:
    """Motors whose rate is linear between the points of a table.

    A constant rate is a table of one point. Ripple makes a shaft that would stand at an angle a of
    its own run at the rate w (1 + r sin(n a)) in place of w.

    Attributes:
        time: (p,) s, increasing; where one stands there twice the rate jumps.
        rate: (p, k) rad/s of each motor; held before the first and after the last point.
        ripple: (k,) r; None for none.
        ripple_order: (k,) n, how often ripple repeats itself in a turn.
    """

    time: Float[Array, " p"]
    rate: Float[Array, "p k"]
    ripple: Float[Array, " k"] | None = None
    ripple_order: Float[Array, " k"] | None = None

    @property
    def is_constant(self) -> bool:
        """Whether the motors turn at constant rates whatever the load."""
        return self.time.shape[0] == 1 and self.ripple is None

    def expected_turn(self, state: State, ahead: Array) -> Float[Array, " k"]:
        """Angle (rad) by which the motors turn in some time (s) after a state."""
        return self.rotation(state.time, state.time + ahead)

    def angle_after(
        self, rod: Rod, state: State, stage: Stage, prediction: Prediction, q: Float[Array, " d"]
    ) -> Float[Array, " k"]:
        """rad, of the motors at the end of a stage, whatever the robot does; see `TorqueMotor`."""
        return stage.motor_angle

    def rates(self, states: State) -> Float[Array, "t k"]:
        """rad/s, of every motor in a stack of states."""
        return self.rate_at(states.time)

    def angles(self, states: State) -> Float[Array, "t k"]:
        """rad, that every motor has turned up to each of a stack of states."""
        return jax.vmap(self.rotation, (None, 0))(jnp.zeros(()), states.time)

    def rotation(self, start: Array, end: Array) -> Float[Array, " k"]:
        """Angle (rad) turned between two times (s), exactly for the piecewise linear rate."""
        turned = self._turned(start, end)
        if self.ripple is None or self.ripple_order is None:
            return turned
        before = self._turned(jnp.zeros_like(start), start)
        steady = self.ripple_order * before, self.ripple_order * (before + turned)
        return turned + self.ripple / self.ripple_order * (jnp.cos(steady[0]) - jnp.cos(steady[1]))

    def rate_at(self, time: Float[Array, " t"]) -> Float[Array, "t k"]:
        """Rate (rad/s) of every motor at some times (s)."""
        rate = self._table_at(time)
        if self.ripple is None or self.ripple_order is None:
            return rate
        angle = jax.vmap(self._turned, (None, 0))(jnp.zeros(()), time)
        return rate * (1.0 + self.ripple * jnp.sin(self.ripple_order * angle))

    def _turned(self, start: Array, end: Array) -> Float[Array, " k"]:
        """Angle (rad) turned between two times (s), but for ripple."""
        if self.time.shape[0] == 1:
            return self.rate[0] * (end - start)
        # The integral of a linear function over each interval of the table that the step
        # overlaps; intervals that it does not touch have zero width.
        edges = jnp.concatenate([jnp.array([-jnp.inf]), self.time, jnp.array([jnp.inf])])
        low = jnp.clip(edges[:-1], start, end)
        high = jnp.clip(edges[1:], start, end)
        middle = 0.5 * (low + high)
        return (high - low) @ self._table_at(middle)

    def _table_at(self, time: Float[Array, " t"]) -> Float[Array, "t k"]:
        """Rate (rad/s) of every motor at some times (s), but for ripple."""
        columns = [jnp.interp(time, self.time, self.rate[:, k]) for k in range(self.rate.shape[1])]
        return jnp.stack(columns, axis=-1)
