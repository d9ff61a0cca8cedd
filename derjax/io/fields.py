"""What the tables of input files are made of: strict keys, and numbers that are numbers."""

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

# Numbers are strict: an integer will do for a float, a string or a boolean will not.
Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[Finite, Field(gt=0)]
NonNegative = Annotated[Finite, Field(ge=0)]
Switch = Annotated[bool, Field(strict=True)]
Count = Annotated[int, Field(strict=True, ge=1)]

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0}
"""Units that the times of a table may be in, in s."""


class Table(BaseModel):
    """A TOML table: immutable, and strict about its keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    def fingerprint(self) -> tuple[dict[str, Any], list[str]]:
        """What it means to a program, see `core.fingerprint`: all keys, and which were given."""
        return dict(self.__dict__), sorted(self.model_fields_set)
