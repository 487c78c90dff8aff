"""Converts recordings to datasets that policies are trained on."""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports
from q2r2_control.extras import require

if TYPE_CHECKING:
    from q2r2_control.export.dataset_card import POSITION as POSITION
    from q2r2_control.export.dataset_card import SOURCES as SOURCES
    from q2r2_control.export.episodes import FrameSampling as FrameSampling
    from q2r2_control.export.episodes import make_episode as make_episode

require("data", "work with recordings")

_MODULES = {
    "FrameSampling": "episodes",
    "POSITION": "dataset_card",
    "SOURCES": "dataset_card",
    "make_episode": "episodes",
}
__all__ = list(_MODULES)
__getattr__, __dir__ = lazy_exports(__name__, _MODULES)
