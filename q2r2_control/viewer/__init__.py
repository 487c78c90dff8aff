"""Views of a run or of a headset's data. The control loop never waits for a view, and no view needs ROS."""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports

if TYPE_CHECKING:
    from q2r2_control.viewer.web.view import PageView as PageView

_MODULES = {
    "PageView": "web.view",
}
__all__ = list(_MODULES)
__getattr__, __dir__ = lazy_exports(__name__, _MODULES)
