"""MuJoCo's own window, which needs OpenGL only when it is asked for."""

from __future__ import annotations

import os
import sys

import mujoco

from q2r2_control.errors import PlantError


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
