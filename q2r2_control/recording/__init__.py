"""Record runs or messages of ROS nodes as MCAP files, which a separate process writes; read and replay recordings.

The recorded hands of a run can also be the input of a new run.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports
from q2r2_control.extras import require

if TYPE_CHECKING:
    from q2r2_control.recording.about import About as About
    from q2r2_control.recording.device_pictures import DevicePictures as DevicePictures
    from q2r2_control.recording.reader import recordings_in as recordings_in
    from q2r2_control.recording.recorder import Recorder as Recorder
    from q2r2_control.recording.recorder import RecordingSummary as RecordingSummary
    from q2r2_control.recording.ros_recording import events_of as events_of

require("data", "work with recordings")

_MODULES = {
    "About": "about",
    "DevicePictures": "device_pictures",
    "Recorder": "recorder",
    "RecordingSummary": "recorder",
    "events_of": "ros_recording",
    "recordings_in": "reader",
}
__all__ = list(_MODULES)
__getattr__, __dir__ = lazy_exports(__name__, _MODULES)
