"""Sources of hand samples. To add an input, implement ``Input`` of ``base``.

``scripted`` contains hand motions, and ``played`` plays them as samples. The motions that handle parts are in
``assembly`` and ``contact_work``. ``headset`` is the TCP server for the Quest2ROS app. ``messages`` and ``session`` are
its protocol without sockets. ``listener`` accepts connections and decides which client drives, and ``connections``
serves the clients. ``webxr`` serves a page for a headset's browser, which replaces the app, and ``page_door`` decides
who may open the page. ``hand_stream`` turns the messages of the app or of the page into samples. ``moved_frame`` and
``samples`` find poses that must not be followed, and queue the others. ``headset_check`` tells people which data come.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports

if TYPE_CHECKING:
    from q2r2_control.inputs.base import adapted as adapted
    from q2r2_control.inputs.base import make_input as make_input
    from q2r2_control.inputs.scripted import HandTrajectory as HandTrajectory
    from q2r2_control.inputs.scripted import ScriptedInput as ScriptedInput
    from q2r2_control.inputs.scripted import trajectory_named as trajectory_named
    from q2r2_control.inputs.web import WebInput as WebInput

_MODULES = {
    "HandTrajectory": "scripted",
    "ScriptedInput": "scripted",
    "WebInput": "web",
    "adapted": "base",
    "make_input": "base",
    "trajectory_named": "scripted",
}
__all__ = list(_MODULES)
__getattr__, __dir__ = lazy_exports(__name__, _MODULES)
