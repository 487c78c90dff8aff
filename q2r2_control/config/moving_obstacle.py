"""An obstacle that appears, moves and disappears while a controller runs."""

from __future__ import annotations

from collections.abc import Collection
from typing import Literal, NamedTuple, Self

from pydantic import Field, model_validator

from q2r2_control.config.cell import ObstacleConfig
from q2r2_control.errors import ConfigError, check_kind, shown


class MovingObstacle(ObstacleConfig):
    """The shape of an obstacle, its pose in the world, and how fast any of its points may move from this pose on."""

    shape: Literal["box", "sphere", "capsule"]
    speed: float = Field(ge=0, le=10, description="largest speed of any of its points; 0: the obstacle stays [m/s]")
    acceleration: float | None = Field(
        None,
        gt=0,
        le=1000,
        description="largest acceleration of any of its points [m/s^2]; null: no limit",
    )
    speed_now: float | None = Field(
        None, ge=0, description="present speed of its fastest point [m/s]; null: the largest speed"
    )
    age: float = Field(0.0, ge=0, description="age of the pose when it is passed on [s]")

    @property
    def slower(self) -> float:
        """The greatest speed of the obstacle's points, ``speed``, minus their present speed, ``speed_now`` [m/s].

        It is 0 if ``acceleration`` or ``speed_now`` is None.
        """
        return 0.0 if self.acceleration is None or self.speed_now is None else self.speed - self.speed_now

    @property
    def rise(self) -> float:
        """The shortest time in which the obstacle's points can reach ``speed`` [s]. It is always above 0."""
        return max(self.slower / (self.acceleration or 1.0), 1e-9)

    @model_validator(mode="after")
    def _is_within_its_speed(self) -> Self:
        if self.speed_now is not None and self.speed_now > self.speed:
            raise ValueError(f"speed_now {self.speed_now:g}: allowed: up to speed, {self.speed:g} m/s")
        return self


class ObstacleReport(NamedTuple):
    """The last report of an obstacle."""

    obstacle: MovingObstacle
    age: float  # The age of the obstacle's pose now [s].


def check_obstacle(name: str, obstacle: MovingObstacle | None, names: Collection[str]) -> None:
    """Raise :class:`ConfigError` if ``name`` is not in ``names``, or if ``obstacle`` is of a wrong type."""
    if not isinstance(name, str) or name not in names:
        allowed = ", ".join(names) or "none; control.moving_obstacles names them"
        raise ConfigError(f"moving obstacle {shown(name)}: allowed: {allowed}")
    if obstacle is not None:
        check_kind(f"obstacle {name}", obstacle, MovingObstacle, "a MovingObstacle, or None to take it away")
