"""The limits of the numbers of an episode, and the messages about numbers outside these limits."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple


@dataclass(frozen=True, slots=True)
class Rejection:
    """A reason why an episode is discarded."""

    name: str  # The name of the threshold, or of a reason that has no threshold: never_engaged, no_ticks, damaged ...
    text: str


class _Unit(NamedTuple):
    name: str = ""
    scale: float = 1.0  # The factor from the SI unit of the threshold to the unit ``name``.


@dataclass(frozen=True, slots=True)
class Threshold:
    """A limit for one number of an episode, or for one number of each of its hands, arms, cameras or subtasks."""

    name: str  # The name of the setting. It begins with min_ for a lower limit, and with max_ for an upper limit.
    of: Literal["episode", "hand", "arm", "measured", "camera", "subtask", "timing"]
    figure: str
    words: str
    unit: _Unit
    figure_in_unit: bool = False  # True if the number is in ``unit`` and not in the threshold's SI unit.
    size_only: bool = False  # True if the sign of the number does not matter.

    def reason(self, value: float | None, limit: float | None, whose: str) -> Rejection | None:
        """Return why a value is beyond the limit, or None if it is not beyond it.

        The result is also None if the value or the limit is None.

        Args:
            value: The number of the episode, in ``unit`` if ``figure_in_unit`` is True, otherwise in the SI unit.
            limit: The limit in the SI unit.
            whose: The words before the message, for example "left arm: ".
        """
        if value is None or limit is None:
            return None
        scale, at_least = self.unit.scale, self.name.startswith("min_")
        found = value / scale if self.figure_in_unit else value
        size = abs(found) if self.size_only else found
        if size >= limit if at_least else size <= limit:
            return None
        shown = f"{whose}{self.words} {scale * found:.1f} {self.unit.name}".strip()
        return Rejection(self.name, f"{shown} ({'at least' if at_least else 'at most'} {scale * limit:.4g})")


_SECONDS, _MM, _MS, _DEGREES = _Unit("s"), _Unit("mm", 1e3), _Unit("ms", 1e3), _Unit("deg", math.degrees(1.0))
_PERCENT, _OF_TIME, _OF_TICKS = (_Unit(f"%{of}", 1e2) for of in ("", " of the time", " of the ticks"))
_OF_DUE, _OF_PICTURES = (_Unit(f"% of the pictures{which}", 1e2) for which in (" that were due", ""))
_TICKS, _PICTURES, _PERIODS = (_Unit(of) for of in ("ticks", "pictures", "of its periods"))
_OF_ITS_LIMIT = _Unit("of its limit")
_NOT_THE_SLOPE = "measured velocities are not those of the positions, off by"
THRESHOLDS = (
    Threshold("min_pose_rate", "hand", "pose_rate_hz", "poses at", _Unit("Hz")),
    Threshold("max_dropout_share", "hand", "dropout_share", "dropouts", _OF_TIME),
    Threshold("max_pose_gap", "hand", "longest_gap_s", "no pose for", _MS),
    Threshold("max_sample_age", "hand", "sample_age_ms_p99", "poses are old when they are used, p99", _MS, True),
    Threshold("max_delay", "arm", "hand_to_tool_ms", "moves later than its hand by", _MS, True),
    Threshold("max_rejected_share", "arm", "rejected_share", "unusable targets", _PERCENT),
    Threshold("max_leashed_share", "arm", "leashed_share", "leash dragged", _OF_TIME),
    Threshold("max_position_error_rms", "arm", "position_error_mm_rms", "tracking error RMS", _MM, True),
    Threshold("max_position_error_p99", "arm", "position_error_mm_p99", "tracking error p99", _MM, True),
    Threshold("max_rotation_error_rms", "arm", "rotation_error_deg_rms", "tracking error RMS", _DEGREES, True),
    Threshold("max_rotation_error_p99", "arm", "rotation_error_deg_p99", "tracking error p99", _DEGREES, True),
    Threshold("min_ldlj", "arm", "ldlj", "not smooth, LDLJ", _Unit()),
    Threshold("max_unmeasured_ticks", "measured", "unmeasured_ticks", "joints or openings are no numbers in", _TICKS),
    Threshold("max_joint_speed", "measured", "joint_speed_share", "a measured joint moves at", _OF_ITS_LIMIT),
    Threshold("max_velocity_mismatch", "measured", "velocity_mismatch", _NOT_THE_SLOPE, _PERCENT),
    Threshold(
        "max_reference_lag",
        "measured",
        "reference_lag_ms",
        "measured joints lag behind the reference by",
        _MS,
        True,
        size_only=True,
    ),
    Threshold("min_picture_rate_share", "camera", "rate_share", "there are", _OF_DUE),
    Threshold("max_picture_gap", "camera", "longest_gap_periods", "no picture for", _PERIODS),
    Threshold("max_frozen_share", "camera", "frozen_share", "the picture stays while arms move", _OF_TIME),
    Threshold("max_black_share", "camera", "black_share", "black or of one colour", _OF_PICTURES),
    Threshold("max_bad_pictures", "camera", "bad_pictures", "damaged, or of another size than the cell's:", _PICTURES),
    Threshold("max_picture_lag", "camera", "lag_ms", "pictures are later than the arms by", _MS, True, size_only=True),
    Threshold("min_subtask_time", "subtask", "duration_s", "takes", _SECONDS),
    Threshold("max_subtask_time", "subtask", "duration_s", "takes", _SECONDS),
    Threshold("max_idle_share", "episode", "idle_share", "idle: no engaged arm moves", _PERCENT),
    Threshold("max_fallback_share", "episode", "fallback_share", "certified stops executed", _OF_TICKS),
    Threshold("max_uncertified_share", "episode", "uncertified_share", "without a certified stop", _OF_TICKS),
    Threshold("min_margin", "episode", "min_margin_mm", "nearer than a pair may be: margin", _MM, True),
    Threshold("max_lost_share", "timing", "lost_share", "ticks lost in the recording", _OF_TICKS),
    Threshold("max_lost_gap", "timing", "longest_lost_s", "ticks lost in the recording, at once", _MS),
    Threshold("max_missed_share", "timing", "missed_share", "loop was late: missed", _OF_TICKS),
    Threshold("max_tick_gap", "timing", "longest_tick_s", "loop stood still for", _MS),
)
