"""The kinds of faults of cameras that are reported during a recording."""

from __future__ import annotations

from q2r2_control.events import ReasonKind


class CameraReason(ReasonKind):
    """Faults of a camera, and the end of a fault. No arm stops because of them."""

    CAMERA_STOPPED = "camera_stopped", "camera {camera}: no picture for {age:.1f} s{why}"
    CAMERA_SLOW = "camera_slow", "camera {camera}: {rate:.1f} pictures a second instead of {due:g}"
    CAMERA_OTHER_SIZE = (
        "camera_other_size",
        "camera {camera}: pictures of {width}x{height}; allowed: {allowed_width}x{allowed_height}",
    )
    CAMERA_BACK = "camera_back", "camera {camera}: pictures again after {gap:.1f} s, {missing} missing"
