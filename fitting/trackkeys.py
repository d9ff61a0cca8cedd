"""Keys of `[[runs]]` on how a track is written, and on what was tracked.

All may be left out. What is left out is found in the file, if `columns` is left out as well; what
was found is said, and what cannot be found is asked for.
"""

from typing import Literal, Self

import numpy as np
from jaxtyping import Float
from pydantic import Field, field_validator, model_validator

from derjax.io.fields import Finite, NonNegative, Positive, Switch, Table

from .formats import NAMES

Direction = Literal["x", "y", "z", "-x", "-y", "-z"]


class Axes(Table):
    """Which axis of the robot points where in the picture: `{ right = "y", up = "-x" }`.

    The first coordinate of a track counts to the right, the second upwards (`y_down` turns it), the
    third towards the camera. Left out, `towards` is what makes the axes right-handed.
    """

    right: Direction
    up: Direction
    towards: Direction | None = None

    @model_validator(mode="after")
    def _three(self) -> Self:
        named = [one[-1] for one in (self.right, self.up, self.towards) if one is not None]
        if len(set(named)) < len(named):
            raise ValueError("each of x, y, z may point in one direction only")
        return self

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """From coordinates of the picture (right, up, towards) to those of the robot."""
        right, up = _unit(self.right), _unit(self.up)
        towards = np.cross(right, up) if self.towards is None else _unit(self.towards)
        return np.stack([right, up, towards], axis=1)


def _unit(direction: str) -> np.ndarray:
    return (-1.0 if direction.startswith("-") else 1.0) * np.eye(3)["xyz".index(direction[-1])]


class TrackKeys(Table):
    """How a track is written, and what was tracked.

    `format` is the program that wrote the table; left out, it is found. `node` is the point to
    follow of an object with several. `y_down` says that the second coordinate points downwards, as
    in images, and `axes` which way the robot's axes point in the picture.

    `point` is what positions are of: the centre of the head, or the centroid of the silhouette, for
    trackers that see the robot as one blob; of such tracks two coordinates are given.

    `several` chooses, where several things were found in a frame, the one that is nearest to the
    last, or the largest. `missing` are the values that stand for a position that was not found;
    left out, -1 and 0 are taken so where the track jumps there and back. `likelihood` is the least
    that counts as found. `max_gap` (in `time_unit`) is the longest time between two frames.

    `angle_period` (in `angle_unit`): the head angle is only known up to so much, as 180 degrees of
    an ellipse; it is unwrapped. `backwards = true` says that the robot does swim the other way than
    its helices should drive it.
    """

    format: str | None = None
    node: str | None = None
    y_down: Switch | None = None
    axes: Axes | None = None
    point: Literal["head", "silhouette"] = "head"
    several: Literal["nearest", "largest"] | None = None
    missing: tuple[Finite, ...] | Finite | None = None
    likelihood: NonNegative | None = None
    angle_period: Positive | None = None
    max_gap: Positive | None = None
    backwards: Switch = Field(default=False)

    @field_validator("format")
    @classmethod
    def _known(cls, name: str | None) -> str | None:
        if name is not None and name not in NAMES:
            raise ValueError(f"should be one of {', '.join(map(repr, NAMES))}")
        return name

    @property
    def sentinels(self) -> tuple[float, ...] | None:
        """The values that stand for nothing; None if they are to be found."""
        return (self.missing,) if isinstance(self.missing, float | int) else self.missing
