"""Take pictures of a simulated cell as JPEG, in a process beside the loop."""

from __future__ import annotations

import io
import os
import pickle
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from q2r2_control.config.recording import CameraConfig
from q2r2_control.errors import PlantError
from q2r2_control.process.helper_process import reason_of
from q2r2_control.types import Array

if TYPE_CHECKING:
    from q2r2_control.plants.mujoco_cameras import CellPictures

# Environment variables of the process that takes pictures. MuJoCo's default way to use OpenGL needs a display; EGL does
# not. Without a graphics card, the CPU draws the pictures. It uses only one thread, so that the loop is not slowed
# down.
ENVIRONMENT = {"MUJOCO_GL": "egl", "LP_NUM_THREADS": "1"}


def open_cameras(model: bytes, cameras: Mapping[str, CameraConfig]) -> CellPictures:
    """Open the cameras of a pickled ``mujoco.MjModel``; raises :class:`PlantError` if OpenGL is missing."""
    try:
        # The import is here, because importing MuJoCo can fail if OpenGL is missing.
        from q2r2_control.plants.mujoco_cameras import CellPictures
    except (ImportError, AttributeError, RuntimeError) as error:
        raise PlantError(f"no pictures: MUJOCO_GL={os.environ['MUJOCO_GL']}: {reason_of(error)}") from error
    return CellPictures(pickle.loads(model), cameras)


def jpeg_of(picture: Array | np.ndarray, quality: int) -> bytes:
    # Pillow is imported here, because runs without pictures, which do not need Pillow, import this module too.
    from PIL import Image

    packed = io.BytesIO()
    Image.fromarray(picture).save(packed, "JPEG", quality=quality)
    return packed.getvalue()
