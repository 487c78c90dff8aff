"""Relative motion: the tool repeats the motion that the hand has made since hand and tool were anchored."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from q2r2_control.config.strict import validated
from q2r2_control.config.teleop import RotationFrame, Stance, TeleopSettings, axes_matrix
from q2r2_control.errors import Q2R2Error, check_kind, shown
from q2r2_control.quaternions import (
    IDENTITY,
    Quaternion,
    Vector,
    floats_of,
    inverse,
    normalized,
    product,
    rotation_of,
    rotation_vector,
    se3_of,
)
from q2r2_control.types import Array, Pose

_REFLECTION = np.diag([1.0, -1.0, 1.0])  # Left and right change sign. Forward and up do not.
# If the hand has turned by more than this angle, the rotation is anchored anew [rad]. Beyond a full turn, rotation
# vectors would not be continuous.
_REANCHOR_ANGLE = 1.5 * math.pi
# In a continuous motion, the rotation vectors of two successive calls differ by less than this [rad].
_CONTINUOUS = 1.0


class RelativeMotion:
    """Maps hand poses to tool poses, relative to an anchor: a pose of the hand and a pose of the tool.

    M is the signed permutation of ``axes``. In the stance ``mirror_reflected``, M is S times this permutation, with
    S = diag(1, -1, 1). In the world, a hand pose (p, R) of the input is (M p, M R M'). With the anchors hand0 and
    tool0, ``target`` is

        position  tool0 + scale diag(axis_scales) (hand - hand0)
        rotation  base frame:  exp(rotation_scale log(R R0')) Rtool0
                  tool frame:  Rtool0 exp(rotation_scale log(R0' R))

    With scales of 1 and the base frame, Quest2ROS2 (HRI 2026) does the same. The caller decides which hand drives which
    arm.

    Every rotation has two rotation vectors: a short one and a longer one in the opposite direction. The vector that
    continues the previous call's vector is used. With a scale other than 1 the tool then does not flip when the hand
    passes half a turn.

    The methods that take tuples of floats are for the loop, and do not check their arguments.

    Raises:
        ConfigError: If a value is not allowed in :class:`TeleopSettings`.
    """

    def __init__(
        self,
        stance: str = "side_by_side",
        scale: float = 1.0,
        rotation_frame: str = "base",
        rotation_scale: float = 1.0,
        axes: Sequence[str] = ("+x", "+y", "+z"),
        axis_scales: Sequence[float] = (1.0, 1.0, 1.0),
    ) -> None:
        given = {"stance": stance, "position_scale": scale, "rotation_scale": rotation_scale}
        given |= {"rotation_frame": rotation_frame, "axes": axes, "axis_scales": axis_scales}
        settings = validated(TeleopSettings, "RelativeMotion: ", given)
        self._scale, self._rotation_scale = self._full = settings.position_scale, settings.rotation_scale
        self._in_tool_frame = settings.rotation_frame is RotationFrame.TOOL
        self._axis_scales = np.array(settings.axis_scales)
        self._map = axes_matrix(settings.axes)
        if settings.stance is Stance.MIRROR_REFLECTED:
            self._map = _REFLECTION @ self._map
        self._axes = self._scaled_axes()
        # M exp(w) M' = exp(det(M) M w): if M is a reflection, a rotation changes its direction.
        self._turn_map: Array = np.linalg.det(self._map) * self._map
        self._turn_axes = _axes_of(self._turn_map)
        self._hand_position: Vector | None = None
        self._hand_rotation = self._hand_back = self._tool_rotation = self._turned_back = IDENTITY
        self._tool_position = self._vector = (0.0, 0.0, 0.0)

    @classmethod
    def of(cls, settings: TeleopSettings) -> RelativeMotion:
        check_kind("settings", settings, TeleopSettings, "TeleopSettings, which a Config has as config.teleop")
        scales = settings.rotation_scale, settings.axes, settings.axis_scales
        return cls(settings.stance, settings.position_scale, settings.rotation_frame, *scales)

    def anchor(self, hand: pin.SE3, tool: pin.SE3) -> None:
        """Let the pose ``hand`` (input's frame) correspond to the pose ``tool`` (world frame) from now on.

        Raises:
            Q2R2Error: If a pose is not finite, or has no rotation matrix. :meth:`target` and :meth:`hand` raise it too.
        """
        self.anchor_floats(_checked_floats("anchor: hand", hand), _checked_floats("anchor: tool", tool))

    def anchor_floats(self, hand: Pose, tool: Pose) -> None:
        self.anchor_position(hand[0], tool[0])
        self.anchor_rotation(hand[1], tool[1])

    def rescale(self, position: float, rotation: float, hand: Pose, tool: Pose) -> None:
        """Multiply the scales of the settings by these factors from now on, and anchor the hand and the tool.

        Because of the new anchor, the target does not jump.

        Args:
            position: Factor of the position scale.
            rotation: Factor of the rotation scale.
            hand: The present hand pose, in the input's frame.
            tool: The present target, in the world frame.
        """
        self._scale, self._rotation_scale = position * self._full[0], rotation * self._full[1]
        self._axes = self._scaled_axes()
        self.anchor_floats(hand, tool)

    def anchor_position(self, hand: Vector, tool: Vector) -> None:
        """Let the position ``hand`` (input's frame) correspond to the position ``tool`` (world frame) from now on.

        The anchor of rotations stays.
        """
        self._hand_position, self._tool_position = hand, tool

    def anchor_rotation(self, hand: Quaternion, tool: Quaternion) -> None:
        """Let the rotation ``hand`` (input's frame) correspond to the rotation ``tool`` (world frame) from now on.

        The anchor of positions stays.
        """
        self._hand_rotation = normalized(hand)
        self._hand_back = inverse(self._hand_rotation)
        self._tool_rotation = tool = normalized(tool)
        back = self._in_world(self._hand_back)
        self._turned_back = product(tool, back) if self._in_tool_frame else product(back, tool)
        self._vector = (0.0, 0.0, 0.0)

    def target(self, hand: pin.SE3) -> pin.SE3:
        """Return the tool's target in the world frame for a hand pose in the input's frame.

        Raises:
            Q2R2Error: If nothing has been anchored.
        """
        return se3_of(self.target_floats(_checked_floats("target: hand", hand)))

    def target_floats(self, hand: Pose) -> Pose:
        if self._hand_position is None:
            raise Q2R2Error("RelativeMotion.target: call anchor(hand, tool) first")
        now, rotation = hand
        before, (x, y, z) = self._hand_position, self._tool_position
        (i, a), (j, b), (k, c) = self._axes
        position = x + a * (now[i] - before[i]), y + b * (now[j] - before[j]), z + c * (now[k] - before[k])
        turned = self._turned_tool(rotation)
        if self._rotation_scale != 1.0 and math.hypot(*self._vector) > _REANCHOR_ANGLE:
            self.anchor_rotation(rotation, turned)
        return position, turned

    def _turned_tool(self, hand: Quaternion) -> Quaternion:
        # Without a scale, M R R0' M' Rtool0 = (M R M') (M R0' M' Rtool0). In the tool's frame, Rtool0 M R0' R M' =
        # (Rtool0 M R0' M') (M R M'). The factors without R are computed at the anchor.
        if self._rotation_scale == 1.0:
            turn, tool = hand, self._turned_back
        else:
            back, tool = self._hand_back, self._tool_rotation
            turn = product(back, hand) if self._in_tool_frame else product(hand, back)
            x, y, z = self._vector = _continued(rotation_vector(turn), self._vector)
            scale = self._rotation_scale
            turn = rotation_of((scale * x, scale * y, scale * z))
        turn = self._in_world(turn)
        return product(tool, turn) if self._in_tool_frame else product(turn, tool)

    def _in_world(self, turn: Quaternion) -> Quaternion:
        """Return the rotation in the world frame that a rotation of the hand stands for: M R M'."""
        (i, a), (j, b), (k, c) = self._turn_axes
        return a * turn[i], b * turn[j], c * turn[k], turn[3]

    def hand(self, tool: pin.SE3) -> pin.SE3:
        """Return the hand pose in the input's frame whose :meth:`target` is ``tool``.

        If the rotation is more than half a turn from the anchor, the returned hand is turned in the shorter direction.
        With a scale of 0 the returned pose has the position or the rotation of the anchored hand.

        Raises:
            Q2R2Error: If nothing has been anchored.
        """
        if self._hand_position is None:
            raise Q2R2Error("RelativeMotion.hand: call anchor(hand, tool) first")
        position, now = _checked_floats("hand: tool", tool)
        scales = self._scale * self._axis_scales
        moved = np.subtract(position, self._tool_position)
        displacement = self._map.T @ np.divide(moved, scales, out=np.zeros(3), where=scales > 0.0)
        rotation = self._hand_rotation
        if self._rotation_scale > 0.0:
            back = inverse(self._tool_rotation)
            scaled = rotation_vector(product(back, now) if self._in_tool_frame else product(now, back))
            x, y, z = (self._turn_map.T @ scaled / self._rotation_scale).tolist()
            turn = rotation_of((x, y, z))
            rotation = product(rotation, turn) if self._in_tool_frame else product(turn, rotation)
        return pin.XYZQUATToSE3((*(self._hand_position + displacement), *rotation))

    def _scaled_axes(self) -> list[tuple[int, float]]:
        return _axes_of(self._scale * self._axis_scales[:, None] * self._map)


def _checked_floats(name: str, pose: pin.SE3) -> Pose:
    """Return a pose as floats. Raises :class:`Q2R2Error` if it is not a finite pose with a rotation matrix."""
    if not isinstance(pose, pin.SE3) or not np.allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-3):
        raise Q2R2Error(f"RelativeMotion.{name} = {shown(pose)}: allowed: a pin.SE3 with a proper rotation")
    if not np.isfinite(pose.translation).all():
        raise Q2R2Error(f"RelativeMotion.{name} = {shown(pose)}: allowed: finite numbers")
    return floats_of(pose)


def _axes_of(matrix: Array) -> list[tuple[int, float]]:
    """Return, for each row of a scaled signed permutation, the column of its only entry, and this entry."""
    sources = np.abs(matrix).argmax(axis=1)
    return [(int(j), float(row[j])) for row, j in zip(matrix, sources, strict=True)]


def _continued(vector: Vector, previous: Vector) -> Vector:
    """Return the vector that continues ``previous``: ``vector``, or the longer vector of the same rotation [rad]."""
    angle = math.hypot(*vector)
    if angle == 0.0:
        return vector
    x, y, z = vector
    share = 1.0 - 2.0 * math.pi / angle
    longer = share * x, share * y, share * z
    return longer if math.dist(longer, previous) < min(_CONTINUOUS, math.dist(vector, previous)) else vector
