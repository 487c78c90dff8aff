"""Checks whether this machine can take pictures without a window."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import cache

import pytest

_PROGRAM = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 16, 16).close()"


@cache
def _can_draw() -> bool:
    environment = {"MUJOCO_GL": "egl", **os.environ}
    return subprocess.run([sys.executable, "-c", _PROGRAM], env=environment, capture_output=True).returncode == 0


def needs_opengl() -> None:
    """Skip the test if this computer cannot draw by OpenGL without a window."""
    if not _can_draw():
        pytest.skip("no OpenGL without a window: libegl1 and libgl1-mesa-dri are not installed")
