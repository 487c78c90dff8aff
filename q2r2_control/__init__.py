"""Bimanual VR teleoperation and Cartesian control with a safe QP controller.

The names of this package are the fixed API, and so are the names of the sub-packages that ``docs/api.md`` lists:
``inputs``, ``plants``, ``process``, ``recording``, ``export``, ``judging``, ``demo``, ``viewer``, ``gym`` and ``ros``.
Everything else may move between versions. A name is imported when it is first used, so that a ROS node that only passes
messages on need not wait for the solver and its compiled kernels.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports

if TYPE_CHECKING:  # The word "as" tells type checkers that a name is public.
    from q2r2_control.config.cell import Config as Config
    from q2r2_control.config.cell import ObstacleConfig as ObstacleConfig
    from q2r2_control.config.cell_file import load_config as load_config
    from q2r2_control.config.control import ControllerSettings as ControllerSettings
    from q2r2_control.config.moving_obstacle import MovingObstacle as MovingObstacle
    from q2r2_control.config.strict import StrictModel as StrictModel
    from q2r2_control.control.constraints import Constraint as Constraint
    from q2r2_control.control.controller import CartesianController as CartesianController
    from q2r2_control.control.qp import QpProblem as QpProblem
    from q2r2_control.control.qp import QpSolution as QpSolution
    from q2r2_control.control.qp import Solver as Solver
    from q2r2_control.control.tasks.elbow import ElbowSwivel as ElbowSwivel
    from q2r2_control.control.tasks.external import Task as Task
    from q2r2_control.control.tasks.named_tasks import JointTarget as JointTarget
    from q2r2_control.control.tasks.named_tasks import LookAt as LookAt
    from q2r2_control.control.tasks.named_tasks import RelativePose as RelativePose
    from q2r2_control.control.tasks.named_tasks import Upright as Upright
    from q2r2_control.device_words import DeviceWords as DeviceWords
    from q2r2_control.errors import CameraError as CameraError
    from q2r2_control.errors import ConfigError as ConfigError
    from q2r2_control.errors import InputError as InputError
    from q2r2_control.errors import PlantError as PlantError
    from q2r2_control.errors import Q2R2Error as Q2R2Error
    from q2r2_control.errors import RecordingError as RecordingError
    from q2r2_control.errors import RobotError as RobotError
    from q2r2_control.events import CommonReason as CommonReason
    from q2r2_control.events import Event as Event
    from q2r2_control.events import Reason as Reason
    from q2r2_control.events import ReasonKind as ReasonKind
    from q2r2_control.export.episodes import EpisodeVectors as EpisodeVectors
    from q2r2_control.export.export_format import ExportFormat as ExportFormat
    from q2r2_control.inputs.base import Input as Input
    from q2r2_control.inputs.policy import ActionSpace as ActionSpace
    from q2r2_control.inputs.policy import PolicyInput as PolicyInput
    from q2r2_control.inputs.policy import action_names as action_names
    from q2r2_control.loop.sampled_targets import SampledTargets as SampledTargets
    from q2r2_control.pipeline.pipeline import Pipeline as Pipeline
    from q2r2_control.plants.base import Plant as Plant
    from q2r2_control.robot.commissioned import load_commissioned as load_commissioned
    from q2r2_control.robot.robot import Robot as Robot
    from q2r2_control.summary.run_summary import RunSummary as RunSummary
    from q2r2_control.summary.tick import Tick as Tick
    from q2r2_control.supervision.reasons import SupervisionReason as SupervisionReason
    from q2r2_control.teleop.reasons import TeleopReason as TeleopReason
    from q2r2_control.teleop.relative import RelativeMotion as RelativeMotion
    from q2r2_control.types import QUEST_CONTROLS as QUEST_CONTROLS
    from q2r2_control.types import Array as Array
    from q2r2_control.types import Command as Command
    from q2r2_control.types import CommandMode as CommandMode
    from q2r2_control.types import DeviceControls as DeviceControls
    from q2r2_control.types import HandInputs as HandInputs
    from q2r2_control.types import HandSample as HandSample
    from q2r2_control.types import HapticFeedback as HapticFeedback
    from q2r2_control.types import Observation as Observation
    from q2r2_control.types import ObservedPicture as ObservedPicture
    from q2r2_control.types import Reference as Reference
    from q2r2_control.types import RobotState as RobotState
    from q2r2_control.types import StepReport as StepReport
    from q2r2_control.wording import sentence as sentence

_MODULES = {
    "ActionSpace": "inputs.policy",
    "Array": "types",
    "CameraError": "errors",
    "CartesianController": "control.controller",
    "Command": "types",
    "CommandMode": "types",
    "CommonReason": "events",
    "Config": "config.cell",
    "ConfigError": "errors",
    "Constraint": "control.constraints",
    "ControllerSettings": "config.control",
    "DeviceControls": "types",
    "DeviceWords": "device_words",
    "ElbowSwivel": "control.tasks.elbow",
    "EpisodeVectors": "export.episodes",
    "Event": "events",
    "ExportFormat": "export.export_format",
    "HandInputs": "types",
    "HandSample": "types",
    "HapticFeedback": "types",
    "Input": "inputs.base",
    "InputError": "errors",
    "JointTarget": "control.tasks.named_tasks",
    "LookAt": "control.tasks.named_tasks",
    "MovingObstacle": "config.moving_obstacle",
    "Observation": "types",
    "ObservedPicture": "types",
    "ObstacleConfig": "config.cell",
    "Pipeline": "pipeline.pipeline",
    "Plant": "plants.base",
    "PlantError": "errors",
    "PolicyInput": "inputs.policy",
    "Q2R2Error": "errors",
    "QUEST_CONTROLS": "types",
    "QpProblem": "control.qp",
    "QpSolution": "control.qp",
    "Reason": "events",
    "ReasonKind": "events",
    "RecordingError": "errors",
    "Reference": "types",
    "RelativeMotion": "teleop.relative",
    "RelativePose": "control.tasks.named_tasks",
    "Robot": "robot.robot",
    "RobotError": "errors",
    "RobotState": "types",
    "RunSummary": "summary.run_summary",
    "SampledTargets": "loop.sampled_targets",
    "Solver": "control.qp",
    "StepReport": "types",
    "StrictModel": "config.strict",
    "SupervisionReason": "supervision.reasons",
    "Task": "control.tasks.external",
    "TeleopReason": "teleop.reasons",
    "Tick": "summary.tick",
    "Upright": "control.tasks.named_tasks",
    "action_names": "inputs.policy",
    "load_commissioned": "robot.commissioned",
    "load_config": "config.cell_file",
    "sentence": "wording",
}
__all__ = list(_MODULES)
__getattr__, __dir__ = lazy_exports(__name__, _MODULES)
