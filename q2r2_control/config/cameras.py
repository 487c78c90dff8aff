"""What the YAML says of the cameras of a cell."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, StringConstraints, model_validator

from q2r2_control.config.arms import Metres3, Radians3
from q2r2_control.config.strict import StrictModel

# It becomes a part of a topic's name and of a feature's.
CameraName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_]*$", max_length=40)]
_LEAST_DISTANCE = 1e-6  # [m]


class CameraConfig(StrictModel):
    """A camera of the simulated cell, or one whose pictures come on a ROS topic.

    The former is fixed in the world or on a link. Its own frame has x the way it looks, and z up in the picture.
    """

    topic: str | None = Field(
        None,
        pattern=r"^(/[A-Za-z_][A-Za-z0-9_]*)+$",
        max_length=200,
        description="ROS topic of a real camera: CompressedImage if it ends with /compressed, else Image",
    )
    link: str | None = Field(None, description="link that carries it, as left_hand_e_base; none: the world")
    position: Metres3 | None = Field(None, description="in the link's frame [m]; not of one with a topic")
    look_at: Metres3 | None = Field(None, description="point in the middle of the picture, in the link's frame [m]")
    rpy: Radians3 | None = Field(None, description="instead of look_at: of the camera's frame in the link's [rad]")
    field_of_view: float = Field(0.9, ge=0.05, le=2.8, description="from the lower to the upper edge [rad]")
    # Even, as video wants them.
    width: int = Field(640, ge=16, le=3840, multiple_of=2, description="[pixels]")
    height: int = Field(480, ge=16, le=2160, multiple_of=2, description="[pixels]")
    rate: float = Field(30.0, gt=0, le=240, description="[pictures/s]")

    @model_validator(mode="after")
    def _looks_one_way(self) -> CameraConfig:
        if self.topic is not None:
            if given := [name for name in ("link", "position", "look_at", "rpy") if getattr(self, name) is not None]:
                raise ValueError(f"{', '.join(given)}: allowed: without topic, which is of a real camera")
            return self
        if self.position is None:
            raise ValueError("allowed: position, or topic of a real camera")
        if (self.look_at is None) == (self.rpy is None):
            raise ValueError("allowed: either look_at or rpy")
        if self.look_at is not None:
            squares = sum((to - at) ** 2 for to, at in zip(self.look_at, self.position, strict=True))
            if squares < _LEAST_DISTANCE**2:
                raise ValueError("look_at is where the camera is: allowed: another point")
        return self
