"""The newest picture of each camera at a tick, for a policy.

The loop only hands over what a picture is made from: a JPEG that a camera's process sent, or the poses of the simulated
bodies. When a policy reads the pixels, they are decoded or rendered in the policy's own thread.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from q2r2_control.config.cell import Config
from q2r2_control.config.recording import CameraConfig
from q2r2_control.errors import CameraError, shown
from q2r2_control.plants.base import PicturedPlant, Plant
from q2r2_control.types import ObservedPicture

if TYPE_CHECKING:
    from q2r2_control.cameras.newest_shots import NewestShots

Pixels = npt.NDArray[np.uint8]  # (height, width, 3) r g b.
_ROUNDING = 1e-6  # Times are rounded, so a picture is due even if this share of its period is missing.


class DrawnPicture:
    """A picture of the simulated cell. Implements :class:`ObservedPicture`."""

    def __init__(self, time: float, draw: Callable[[], Pixels]) -> None:
        self.time, self._draw = time, draw

    @cached_property
    def pixels(self) -> Pixels:
        return self._draw()


class PicturesByCamera(dict[str, ObservedPicture]):
    """Pictures by the name of their camera. Reading a missing picture raises :class:`CameraError`, which says why."""

    def __init__(self, pictures: Mapping[str, ObservedPicture], reasons: Mapping[str, str]) -> None:
        super().__init__(pictures)
        self._reasons = reasons

    def __missing__(self, name: str) -> ObservedPicture:
        known = ", ".join(sorted({*self, *self._reasons})) or "none, since the cell has no cameras"
        why = self._reasons.get(name, f"no such camera; allowed: {known}")
        raise CameraError(f"camera {name if name in self._reasons else shown(name)}: {why}")


class NewestPictures:
    """The newest pictures at each tick of one run."""

    def __init__(self, config: Config, plant: Plant, shots: NewestShots | None) -> None:
        """``shots`` are the pictures of the open real cameras, or None if none is open."""
        self._shots = shots
        self._drawn: dict[str, _DrawnCamera] = {}
        if isinstance(plant, PicturedPlant):
            drawn = config.simulated_cameras.items()
            self._drawn = {name: _DrawnCamera(name, camera.rate, plant) for name, camera in drawn}
        self._reasons = {
            name: _why_without(camera)
            for name, camera in config.cameras.items()
            if name not in {*(() if shots is None else shots.names), *self._drawn}
        }

    def at(self, now: float) -> PicturesByCamera:
        """Return the newest picture of each camera at the tick whose time is ``now`` [s], without waiting."""
        found: dict[str, ObservedPicture] = {name: camera.at(now) for name, camera in self._drawn.items()}
        if self._shots is None:
            return PicturesByCamera(found, self._reasons)
        of_devices, reasons = self._shots.at(now)
        return PicturesByCamera(found | of_devices, self._reasons | reasons)


def _why_without(camera: CameraConfig) -> str:
    if camera.topic is not None:
        return "its pictures are on a ROS topic; allowed: of simulated cameras, and of devices"
    return "it is simulated, and this plant has no pictures" if camera.is_simulated else "this run has not opened it"


class _DrawnCamera:
    """One camera of a simulated cell, with a picture at each of its periods, as in a recording."""

    def __init__(self, name: str, rate: float, plant: PicturedPlant) -> None:
        self._name, self._rate, self._plant = name, rate, plant
        self._start: float | None = None  # Time of the first tick [s].
        self._number = 0  # Number of the newest picture, counted in periods since the first tick.
        self._newest: DrawnPicture | None = None

    def at(self, now: float) -> DrawnPicture:
        if self._start is None:
            self._start = now
        number = math.floor((now - self._start) * self._rate + _ROUNDING)
        if self._newest is None or number > self._number:
            self._number, self._newest = number, DrawnPicture(now, self._plant.picture_of(self._name))
        return self._newest
