"""MuJoCo's own window and pictures without a window. Only these need OpenGL, and only when they are asked for."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt

from q2r2_control.errors import PlantError


@dataclass(frozen=True, slots=True)
class Camera:
    """Where a picture is taken from: ``distance`` [m] away from ``target`` (world, [m]), angles in degrees."""

    target: tuple[float, float, float] = (0.42, 0.0, 0.34)
    distance: float = 2.3
    azimuth: float = 145.0  # direction of sight in the x-y plane, counted from x
    elevation: float = -20.0  # negative looks down


class Window:
    """MuJoCo's passive viewer on a running simulation."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Raises :class:`PlantError` where there is no display."""
        _check_display()
        from mujoco import viewer

        try:
            self._handle = viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
        except (RuntimeError, mujoco.FatalError) as error:
            raise PlantError(f"MuJoCo's window cannot be opened: {error}") from error

    @property
    def is_open(self) -> bool:
        """False once the user has closed it."""
        return bool(self._handle.is_running())

    def sync(self) -> None:
        """Show the state of now; nothing happens when the user has closed the window."""
        if self.is_open:
            self._handle.sync()

    def close(self) -> None:
        """Close the window."""
        self._handle.close()


def take_picture(
    model: mujoco.MjModel, data: mujoco.MjData, width: int, height: int, camera: Camera
) -> npt.NDArray[np.uint8]:
    """Picture (height, width, 3) of the cell. Raises :class:`PlantError` where OpenGL or the size does not allow it."""
    largest = model.vis.global_.offwidth, model.vis.global_.offheight
    if not (0 < width <= largest[0] and 0 < height <= largest[1]):
        raise PlantError(f"picture of {width} x {height}: allowed: 1 x 1 .. {largest[0]} x {largest[1]} pixels")
    view = mujoco.MjvCamera()
    view.lookat, view.distance = camera.target, camera.distance
    view.azimuth, view.elevation = camera.azimuth, camera.elevation
    try:
        with mujoco.Renderer(model, height=height, width=width) as renderer:
            renderer.update_scene(data, view)
            return renderer.render()
    except (ImportError, RuntimeError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split())
        raise PlantError(
            f"no picture: {reason}; without a display, set MUJOCO_GL=egl in the environment "
            "(on Debian that takes libegl1 and libgl1-mesa-dri)"
        ) from error


def _check_display() -> None:
    """MuJoCo waits for ever for a window that its thread cannot open, so try first."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise PlantError("MuJoCo's window needs a display: neither DISPLAY nor WAYLAND_DISPLAY is set; run headless")
    import glfw

    try:
        ready = glfw.init()
    except glfw.GLFWError as error:
        raise PlantError(f"MuJoCo's window cannot be opened: {error}") from error
    if not ready:
        raise PlantError("MuJoCo's window cannot be opened on this display; run headless")
