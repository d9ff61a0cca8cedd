"""[gravity]: weight and buoyancy."""

import jax.numpy as jnp

from ...io.fields import Finite
from ...terms.gravity import Gravity
from ...terms.term import Term
from .ingredient import Ingredient, Setting
from .masses import buoyant_mass


class GravityTable(Ingredient):
    """[gravity] Acceleration (m/s^2); a scene without this table has no gravity."""

    acceleration: tuple[Finite, Finite, Finite] = (0.0, 0.0, -9.81)

    def terms(self, setting: Setting) -> list[Term]:
        """Weight less buoyancy."""
        return [Gravity(buoyant_mass(setting), jnp.array(self.acceleration))]
