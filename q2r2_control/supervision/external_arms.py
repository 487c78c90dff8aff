"""Arms that another controller moves after our safe targets: tools are led, elbows go where that controller puts them.

The reference keeps the arms apart only as far as the arms are where it is. For that reason its elbows follow the
measured ones, held tools keep their pose instead of joint positions, and measured pairs may not be closer than the
reference's may, less a tolerance for the lag of an arm.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from q2r2_control.config.cell import Config
from q2r2_control.control.controller import CartesianController
from q2r2_control.events import Reason, ReasonKind
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.pairs import pair_names
from q2r2_control.robot.robot import Robot
from q2r2_control.supervision.joint_watch import WatchSettings
from q2r2_control.supervision.target_stream import StreamSettings, apart
from q2r2_control.types import Reference, RobotState

_REST = 0.01  # a held arm's joints are slower before its tool's pose is taken [rad/s]
# How fast the reference's elbows follow the measured ones [1/s], [rad/s].
_FOLLOW = {"posture_gain": 10.0, "posture_speed": 1.5}


@dataclass(slots=True)
class ExternalSettings:
    """What is allowed of arms that another controller moves; may be changed at run time."""

    tolerance: float = 0.01  # measured pairs may be closer by this than they are kept apart [m]


def settings_for_external_arms(config: Config) -> Config:
    """The cell's configuration with elbows that are free to follow."""
    control = config.control.model_copy(update=_FOLLOW)
    stiff = config.admittance.model_copy(update={"enabled": False})  # compliance is the other controller's
    return config.model_copy(update={"control": control, "admittance": stiff})


class ExternalArms:
    """What the controller is asked for, and what is checked, where it only leads."""

    def __init__(
        self,
        robot: Robot,
        controller: CartesianController,
        settings: ExternalSettings,
        streams: StreamSettings,
        watch: WatchSettings,
    ) -> None:
        self._robot, self._controller, self._settings = robot, controller, settings
        self._streams, self._watch = streams, watch
        self._keys = kept_distances(robot, controller.settings).keys
        self._near_at: dict[str, float] = {}  # when an arm's tool was last seen near [s]
        self._held: dict[str, pin.SE3] = {}

    def begin(self) -> None:
        """Start anew at rest."""
        self._held.clear()
        self._near_at.clear()

    def targets(self, wanted: dict[str, pin.SE3 | None], last: Reference | None) -> dict[str, pin.SE3 | None]:
        """The same targets with the tool's own pose for each arm that has none and rests in the ``last`` reference."""
        for arm, pose in wanted.items():
            if pose is not None:
                self._held.pop(arm, None)
            elif arm not in self._held and (last is None or np.abs(last.v[self._robot.arms[arm].joints]).max() < _REST):
                self._held[arm] = self._controller.tool_pose(arm)
        return {arm: self._held.get(arm, pose) for arm, pose in wanted.items()}

    def left_behind(self, state: RobotState, holding: Iterable[str], now: float) -> Reason | None:
        """A reason where the tool of a ``holding`` arm has been away from its reference's for too long, else None.

        Nothing moves that arm, and it could not be engaged: a stream has to begin where tool and reference both are.
        """
        holding = set(holding)
        for arm in self._robot.arms:
            tool, led = self._robot.tool_pose(state.q, arm), self._controller.tool_pose(arm)
            way, turn = apart(tool, led)
            near = way <= self._streams.engage_distance and turn <= self._streams.engage_angle
            if near or arm not in holding or arm not in self._near_at:
                self._near_at[arm] = now
            elif now - self._near_at[arm] > self._watch.deviation_time:
                return Reason.of(ReasonKind.LEFT_BEHIND, arm=arm, distance=way, angle=turn)
        return None

    def too_close(self, state: RobotState) -> Reason | None:
        """A reason where a measured pair is closer than allowed, else None."""
        distances, kept = self._robot.distance_values(state.q), self._controller.kept_distances
        if (distances - kept).min(initial=np.inf) >= -self._settings.tolerance:
            return None
        tightest = int(np.argmin(distances - kept))
        least, tolerance = kept[tightest], self._settings.tolerance
        return Reason.of(
            ReasonKind.TOO_CLOSE,
            pair="|".join(pair_names(self._robot.collision_model)[tightest]),
            distance=float(distances[tightest]),
            allowed=float(least - tolerance),
            key=self._keys[tightest],
            kept=float(least),
            tolerance=tolerance,
        )
