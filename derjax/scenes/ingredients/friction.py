"""[friction]: Coulomb's friction of rods that touch."""

from collections.abc import Mapping
from typing import Annotated, ClassVar

import jax.numpy as jnp
from jaxtyping import Array
from pydantic import Field

from ...io.fields import NonNegative, Positive
from ...terms.contact.friction import Friction
from ...terms.term import Term
from .ingredient import Idle, Ingredient, Parameter, Setting, because

SLIP = 0.1
"""Speed below which friction is like drag, over that of the surface of a rod that turns with the
fastest motor."""


class FrictionTable(Ingredient):
    """[friction] Coulomb friction of touching rods, regularised below `slip_speed` (m/s).

    That is by default a part (`SLIP`) of the speed of the surface of a rod that turns
    about its axis with the fastest motor.
    A scene without this table, or with a coefficient of zero, has no friction.
    """

    PARAMETERS: ClassVar[Mapping[str, Parameter]] = {
        "coefficient": Parameter("friction", "1", when=lambda s: s.rubbing)
    }
    IDLE: ClassVar[tuple[Idle, ...]] = (
        Idle(("slip_speed",), lambda s: not s.rubbing, because("with coefficient = 0")),
    )

    coefficient: Annotated[NonNegative, Field(le=10)] = 0.3
    slip_speed: Positive | None = None

    def terms(self, setting: Setting) -> list[Term]:
        """Friction at the contacts of the scene's `Contact`."""
        if not setting.file.rubbing or setting.file.contact_method != "smooth":
            return []
        return [Friction(setting.numbers["friction"], self._slip_speed(setting))]

    def _slip_speed(self, setting: Setting) -> Array:
        """m/s."""
        if self.slip_speed is not None:
            return jnp.array(self.slip_speed)
        p = setting.numbers
        rpm = p["free_rpm"] if "free_rpm" in p else p["rpm"]
        return SLIP * (2 * jnp.pi / 60) * jnp.max(jnp.abs(rpm)) * p["rod_radius"]
