"""Bimanual VR teleoperation and Cartesian control with a safe QP controller.

The fixed API; everything else may move between versions. A name is imported when it is first asked for. A ROS node that
passes messages on then need not wait for the solver and its compiled kernels.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports

if TYPE_CHECKING:
    from q2r2_control.config.cell import load_config
    from q2r2_control.config.control import ControllerSettings
    from q2r2_control.control.controller import CartesianController
    from q2r2_control.errors import ConfigError, Q2R2Error
    from q2r2_control.pipeline.pipeline import Pipeline
    from q2r2_control.robot.robot import Robot
    from q2r2_control.summary.run_summary import RunSummary
    from q2r2_control.teleop.relative import RelativeMotion

__all__ = [
    "CartesianController",
    "ConfigError",
    "ControllerSettings",
    "Pipeline",
    "Q2R2Error",
    "RelativeMotion",
    "Robot",
    "RunSummary",
    "load_config",
]

__getattr__ = lazy_exports(
    __name__,
    {
        "CartesianController": "control.controller",
        "ConfigError": "errors",
        "ControllerSettings": "config.control",
        "Pipeline": "pipeline.pipeline",
        "Q2R2Error": "errors",
        "RelativeMotion": "teleop.relative",
        "Robot": "robot.robot",
        "RunSummary": "summary.run_summary",
        "load_config": "config.cell",
    },
)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
