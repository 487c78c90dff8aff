"""Robots that move, simulated or real.

A new plant implements ``Plant`` of ``base``, which also has the checks of commands. MuJoCo is imported only when it is
used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports

if TYPE_CHECKING:
    from q2r2_control.plants.base import FaultReportingPlant as FaultReportingPlant
    from q2r2_control.plants.base import RealPlant as RealPlant
    from q2r2_control.plants.base import SessionPlant as SessionPlant
    from q2r2_control.plants.base import WaitingPlant as WaitingPlant
    from q2r2_control.plants.base import WindowedPlant as WindowedPlant
    from q2r2_control.plants.base import check_command as check_command
    from q2r2_control.plants.fri.answers import ReferencePath as ReferencePath
    from q2r2_control.plants.fri.reasons import FriReason as FriReason
    from q2r2_control.plants.mujoco import MujocoPlant as MujocoPlant
    from q2r2_control.plants.mujoco_cameras import CellPictures as CellPictures
    from q2r2_control.types import ArmTiming as ArmTiming

_MODULES = {
    "ArmTiming": ".types",
    "CellPictures": "mujoco_cameras",
    "FaultReportingPlant": "base",
    "FriReason": "fri.reasons",
    "MujocoPlant": "mujoco",
    "ReferencePath": "fri.answers",
    "RealPlant": "base",
    "SessionPlant": "base",
    "WaitingPlant": "base",
    "WindowedPlant": "base",
    "check_command": "base",
}
__all__ = list(_MODULES)
__getattr__, __dir__ = lazy_exports(__name__, _MODULES)
