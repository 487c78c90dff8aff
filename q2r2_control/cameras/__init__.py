"""Real cameras without ROS: devices of this computer and its network, each read by a process of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports

if TYPE_CHECKING:
    from q2r2_control.cameras.camera_streams import CameraStreams as CameraStreams

_MODULES = {"CameraStreams": "camera_streams"}
__all__ = list(_MODULES)
__getattr__, __dir__ = lazy_exports(__name__, _MODULES)
