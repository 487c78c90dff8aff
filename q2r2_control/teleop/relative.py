"""Relative motion: the tool repeats what the hand has done since both were anchored."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from pydantic import ValidationError

from q2r2_control.config.axes import axes_matrix
from q2r2_control.config.teleop import RotationFrame, Stance, TeleopSettings
from q2r2_control.errors import ConfigError, Q2R2Error
from q2r2_control.types import Array, pose_of

# Left and right change sign, forward and up do not.
_REFLECTION = np.diag([1.0, -1.0, 1.0])
# Past this angle the anchor moves along: a rotation vector has no continuous continuation past a full turn.
_REANCHOR_ANGLE = 1.5 * math.pi
# Two rotation vectors of one continuous motion are closer than this between two calls [rad].
_CONTINUOUS = 1.0


class RelativeMotion:
    """Maps hand poses to tool poses, relative to an anchor of both.

    With M the signed permutation ``axes``, preceded by S = diag(1, -1, 1) in the stance ``mirror_reflected``, a hand
    pose (p, R) counts in the world as (M p, M R M'). With anchors hand0 and tool0, ``target`` is

        position  tool0 + scale diag(axis_scales) (hand - hand0)
        rotation  base frame:  exp(rotation_scale log(R R0')) Rtool0
                  tool frame:  Rtool0 exp(rotation_scale log(R0' R))

    as in Quest2ROS2 (HRI 2026) for scales of 1 in the base frame. Which hand drives which arm is not decided here.

    Every rotation has a second, longer rotation vector; the one that continues the previous call's is used, so that
    with a scale other than 1 the tool does not flip when the hand passes half a turn.

    Raises :class:`ConfigError` for a value that is not allowed in :class:`TeleopSettings`.
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
        try:
            settings = TeleopSettings.model_validate(
                {
                    "stance": stance,
                    "position_scale": scale,
                    "rotation_frame": rotation_frame,
                    "rotation_scale": rotation_scale,
                    "axes": axes,
                    "axis_scales": axis_scales,
                }
            )
        except ValidationError as error:
            fault = error.errors()[0]
            key = ".".join(str(part) for part in fault["loc"])
            raise ConfigError(f"RelativeMotion: {key} = {fault['input']!r:.60}: {fault['msg']}") from error
        self._scale, self._rotation_scale = self._full = settings.position_scale, settings.rotation_scale
        self._in_tool_frame = settings.rotation_frame is RotationFrame.TOOL
        self._axis_scales = np.array(settings.axis_scales)
        self._map = axes_matrix(settings.axes)
        if settings.stance is Stance.MIRROR_REFLECTED:
            self._map = _REFLECTION @ self._map
        self._axes = self._scaled_axes()
        self._hand_position: list[float] | None = None
        self._hand_rotation = np.eye(3)
        self._tool_position = [0.0, 0.0, 0.0]
        # The tool's rotation is before * (the hand's own rotation since the anchor) * after.
        self._before = self._after = np.eye(3)
        self._vector = np.zeros(3)

    @classmethod
    def of(cls, settings: TeleopSettings) -> RelativeMotion:
        """As an operator's settings say."""
        scales = settings.rotation_scale, settings.axes, settings.axis_scales
        return cls(settings.stance, settings.position_scale, settings.rotation_frame, *scales)

    def anchor(self, hand: pin.SE3, tool: pin.SE3) -> None:
        """Make ``hand`` (finite, input's frame) and ``tool`` (world frame) correspond from now on."""
        self.anchor_position(hand, tool)
        self.anchor_rotation(hand, tool)

    def rescale(self, position: float, rotation: float, hand: pin.SE3, tool: pin.SE3) -> None:
        """From now on scale by these shares of the scales; ``hand`` and ``tool`` are anchored, so nothing jumps.

        A share of 0 keeps the tool's position, or its rotation, where it is.
        """
        self._scale, self._rotation_scale = position * self._full[0], rotation * self._full[1]
        self._axes = self._scaled_axes()
        self.anchor(hand, tool)

    def anchor_position(self, hand: pin.SE3, tool: pin.SE3) -> None:
        """Make only the positions of ``hand`` and ``tool`` correspond from now on; rotations go on as they were."""
        self._hand_position = hand.translation.tolist()
        self._tool_position = tool.translation.tolist()

    def anchor_rotation(self, hand: pin.SE3, tool: pin.SE3) -> None:
        """Make only the rotations of ``hand`` and ``tool`` correspond from now on; positions go on as they were."""
        self._hand_rotation = np.array(hand.rotation)
        rotation = _orthonormal(tool.rotation)
        # M exp(s w) M' = exp(s M w), up to the sign that a reflection gives an axis: scaling and mapping commute.
        if self._in_tool_frame:
            self._before, self._after = rotation @ self._map, self._map.T
        else:
            self._before, self._after = self._map, self._map.T @ rotation
        self._vector = np.zeros(3)

    def target(self, hand: pin.SE3) -> pin.SE3:
        """Tool pose in the world frame for a hand pose in the input's frame.

        Raises :class:`Q2R2Error` when nothing has been anchored.
        """
        if self._hand_position is None:
            raise Q2R2Error("RelativeMotion.target: call anchor(hand, tool) first")
        # At every tick: sums of floats cost a third of NumPy's of vectors of three, and dot a third of @.
        now, before, tool = hand.translation.tolist(), self._hand_position, self._tool_position
        (i, a), (j, b), (k, c) = self._axes
        x, y, z = a * (now[i] - before[i]), b * (now[j] - before[j]), c * (now[k] - before[k])
        anchored, turned = self._hand_rotation.T, hand.rotation
        turn = anchored.dot(turned) if self._in_tool_frame else turned.dot(anchored)
        rotation = self._before.dot(self._scaled(turn)).dot(self._after)
        target = pose_of(rotation, np.array((tool[0] + x, tool[1] + y, tool[2] + z)))
        if self._rotation_scale != 1.0 and np.linalg.norm(self._vector) > _REANCHOR_ANGLE:
            self.anchor_rotation(hand, target)
        return target

    def hand(self, tool: pin.SE3) -> pin.SE3:
        """The hand pose, in the input's frame, whose :meth:`target` is ``tool``: where an operator has to put the hand.

        Of rotations beyond half a turn from the anchor the shorter one is taken. With a scale of 0, with which no hand
        can move or turn the tool, the hand keeps its position or rotation. Raises :class:`Q2R2Error` when nothing has
        been anchored.
        """
        if self._hand_position is None:
            raise Q2R2Error("RelativeMotion.hand: call anchor(hand, tool) first")
        scales = self._scale * self._axis_scales
        moved = tool.translation - self._tool_position
        way = self._map.T @ np.divide(moved, scales, out=np.zeros(3), where=scales > 0.0)
        turn = np.eye(3)
        if self._rotation_scale > 0.0:
            scaled = self._before.T @ tool.rotation @ self._after.T
            turn = pin.exp3(pin.log3(scaled) / self._rotation_scale)
        anchor = self._hand_rotation
        return pin.SE3(anchor @ turn if self._in_tool_frame else turn @ anchor, self._hand_position + way)

    def _scaled_axes(self) -> list[tuple[int, float]]:
        """A signed permutation: each axis of the tool goes along one of the hand's, by so much of it."""
        sources = np.abs(self._map).argmax(axis=1)
        rows = zip(self._map, sources, self._axis_scales.tolist(), strict=True)
        return [(int(j), self._scale * scale * float(row[j])) for row, j, scale in rows]

    def _scaled(self, rotation: Array) -> Array:
        if self._rotation_scale == 1.0:
            return rotation
        self._vector = _continued(pin.log3(rotation), self._vector)
        return pin.exp3(self._rotation_scale * self._vector)


def _continued(vector: Array, previous: Array) -> Array:
    """Of the two rotation vectors of one rotation, shorter than a turn, the one that continues ``previous``."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return vector
    longer = vector * (1.0 - 2.0 * math.pi / angle)
    gap = float(np.linalg.norm(longer - previous))
    return longer if gap < min(_CONTINUOUS, float(np.linalg.norm(vector - previous))) else vector


def _orthonormal(rotation: Array) -> Array:
    """Keeps rounding from adding up over any number of anchors."""
    return pin.Quaternion(rotation).normalized().toRotationMatrix()
