"""Settings of cameras and recordings, and thresholds that a recorded episode has to meet, with units and ranges."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import Field, StringConstraints, model_validator

from q2r2_control.config.arms import LocalPath, Metres3, Radians3, Share
from q2r2_control.config.strict import StrictModel

Seconds = Annotated[float, Field(ge=0, le=10)]
Metres = Annotated[float, Field(ge=0, le=2)]
Radians = Annotated[float, Field(ge=0, le=3.15)]
SubtaskSeconds = Annotated[float, Field(ge=0, le=3600)]


class JudgeSettings(StrictModel):
    """Thresholds of ``q2r2 judge``: an episode that fails any of them is discarded. A threshold of null is not checked.

    Shares are fractions of the time for which an arm is engaged, unless a description says otherwise. No threshold thus
    depends on the length of an episode. The package ``q2r2_control.judging`` computes the numbers.
    """

    min_pose_rate: Annotated[float, Field(ge=0, le=1000)] | None = Field(
        30.0, description="smallest rate of poses from a hand that leads an engaged arm [Hz]"
    )
    dropout: float = Field(0.06, ge=0.005, le=1, description="a longer time between two poses is a dropout [s]")
    max_dropout_share: Share | None = Field(0.05, description="largest share of time within dropouts")
    max_pose_gap: Seconds | None = Field(0.12, description="longest time without a pose [s]")
    max_sample_age: Seconds | None = Field(0.04, description="largest age of poses when a tick uses them, p99 [s]")
    max_delay: Seconds | None = Field(
        0.12, description="largest delay from the motion of a hand to that of its tool [s]"
    )
    max_faults: Annotated[int, Field(ge=0, le=1000)] | None = Field(
        0, description="largest number of pauses by faults: jumps, lost hands, refused targets"
    )
    max_rejected_share: Share | None = Field(
        0.01, description="largest share of targets that the controller could not use"
    )
    max_leashed_share: Share | None = Field(
        0.05, description="largest share of time in which the leash drags the target along with the tool"
    )
    max_position_error_rms: Metres | None = Field(
        0.025, description="largest RMS distance from target to measured tool [m]"
    )
    max_position_error_p99: Metres | None = Field(
        0.07, description="largest p99 distance from target to measured tool [m]"
    )
    max_rotation_error_rms: Radians | None = Field(
        0.15, description="largest RMS angle from target to measured tool [rad]"
    )
    max_rotation_error_p99: Radians | None = Field(
        0.4, description="largest p99 angle from target to measured tool [rad]"
    )
    max_unmeasured_ticks: Annotated[int, Field(ge=0, le=10**9)] | None = Field(
        0, description="largest number of ticks in which joints, openings or references are not finite"
    )
    max_joint_speed: Annotated[float, Field(gt=0, le=100)] | None = Field(
        1.2, description="largest measured speed of a joint, divided by the joint's limit"
    )
    max_velocity_mismatch: Annotated[float, Field(ge=0, le=100)] | None = Field(
        0.5, description="largest difference of measured velocities from the slope of positions, divided by that slope"
    )
    max_reference_lag: Seconds | None = Field(
        0.12, description="largest delay or lead of measured joints relative to the reference [s]"
    )
    min_picture_rate_share: Share | None = Field(
        0.8, description="smallest share of a camera's pictures that were recorded"
    )
    max_picture_gap: Annotated[float, Field(ge=1, le=1000)] | None = Field(
        2.5, description="longest time without a picture of a camera, in its periods"
    )
    max_frozen_share: Share | None = Field(
        0.2, description="largest share of time in which a camera's picture stays equal while the arms move"
    )
    max_black_share: Share | None = Field(0.05, description="largest share of pictures that are black or of one colour")
    max_bad_pictures: Annotated[int, Field(ge=0, le=10**6)] | None = Field(
        0, description="largest number of pictures that are damaged or have a wrong size"
    )
    max_picture_lag: Seconds | None = Field(
        0.12, description="largest delay of the motion in pictures behind that of the joints [s]"
    )
    max_idle_share: Share | None = Field(
        0.5, description="largest share of the whole run in which no engaged arm moves"
    )
    min_ldlj: Annotated[float, Field(ge=-100, le=0)] | None = Field(
        -11.0, description="smallest smoothness of the tool: log dimensionless jerk; nearer to 0 is smoother"
    )
    max_fallback_share: Share | None = Field(
        0.05, description="largest share of ticks that executed the certified stop"
    )
    max_uncertified_share: Share | None = Field(0.0, description="largest share of ticks without a certified stop")
    min_margin: Annotated[float, Field(ge=-1, le=1)] | None = Field(
        -0.001, description="smallest margin of a pair: its distance minus the kept distance [m]"
    )
    max_lost_share: Share | None = Field(0.01, description="largest share of ticks that are missing in the file")
    max_lost_gap: Seconds | None = Field(0.03, description="longest time without a tick in the file [s]")
    max_missed_share: Share | None = Field(
        0.5, description="largest share of ticks that the loop missed because it was late"
    )
    max_tick_gap: Seconds | None = Field(0.1, description="longest time between two ticks of the loop [s]")
    min_subtask_time: SubtaskSeconds | None = Field(None, description="shortest time of a subtask of the episode [s]")
    max_subtask_time: SubtaskSeconds | None = Field(None, description="longest time of a subtask of the episode [s]")
    needs_subtasks: bool = Field(
        True, description="episodes without some of the subtasks that recording.subtasks names are discarded"
    )
    keep_failed: bool = Field(False, description="episodes that failed, by their operator or task, are kept")
    needs_task: bool = Field(False, description="episodes without a task in words are discarded")
    needs_end: bool = Field(True, description="files without an end, as after a killed process, are discarded")


TOPIC_RATE = 100.0  # Default rate of the standard topics in a recording [Hz].
SubtaskName = Annotated[str, StringConstraints(pattern=r"^\S(.*\S)?$", max_length=200)]


class RecordingSettings(StrictModel):
    """The amount of data that ``q2r2 run --record`` writes, and the subtasks of an episode."""

    topic_rate: Annotated[float, Field(gt=0, le=1000)] | None = Field(
        TOPIC_RATE,
        description="rate of the standard topics, which repeat numbers of the tick [Hz]; null: every tick",
    )
    subtasks: tuple[SubtaskName, ...] = Field(
        (),
        max_length=100,
        description="names of an episode's subtasks, in their order; the first one begins with the episode, and each "
        "next_subtask of the operator begins another; none: they have numbers, and there may be any number of them",
    )


def subtask_name(names: Sequence[str], number: int) -> str:
    """Return the name of subtask ``number``, from 1 on; ``names`` is ``recording.subtasks``."""
    return names[number - 1] if number <= len(names) else f"subtask {number}"


def subtask_names(names: Sequence[str], presses: int) -> tuple[str, ...]:
    """Return the names of the subtasks that have begun in an episode; empty if the episode has no subtasks.

    ``names`` is ``recording.subtasks``, and ``presses`` is how often the operator began another subtask.
    """
    return tuple(subtask_name(names, number) for number in range(1, presses + 2)) if names or presses else ()


# The name of a camera is a part of the names of its topic and of its feature in a dataset.
CameraName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_]*$", max_length=40)]
DeviceNumber = Annotated[int, Field(ge=0, le=255)]
DeviceText = Annotated[LocalPath, Field(min_length=1, max_length=500)]
_LEAST_DISTANCE = 1e-6  # Least distance between a camera and the point that it looks at [m].
_POSE_KEYS = ("position", "look_at", "rpy")  # Keys that only a simulated camera has.
_DEVICE_KEYS = ("exposure", "rotation", "delay", "repeat", "depth")  # Keys that only a device has.
REALSENSE = "realsense:"  # The beginning of ``device`` for a RealSense camera. A serial number follows.


class CameraConfig(StrictModel):
    """A camera of the simulated cell, a real camera on a ROS topic, or a device that this computer opens.

    A simulated camera is fixed in the world or on a link. In its own frame, x is the direction of view, and z points
    up in the picture.
    """

    topic: str | None = Field(
        None,
        pattern=r"^(/[A-Za-z_][A-Za-z0-9_]*)+$",
        max_length=200,
        description="ROS topic of a real camera: CompressedImage if it ends with /compressed, else Image",
    )
    device: DeviceNumber | DeviceText | None = Field(
        None,
        description="real camera without ROS: V4L2 number or path, realsense:SERIAL, rtsp:// or http:// address, or a "
        "video file",
    )
    link: str | None = Field(
        None, description="link that carries the camera, such as left_hand_e_base; null: the world"
    )
    position: Metres3 | None = Field(None, description="position of a simulated camera in the link's frame [m]")
    look_at: Metres3 | None = Field(None, description="point in the middle of the picture, in the link's frame [m]")
    rpy: Radians3 | None = Field(
        None, description="rotation of the camera in the link's frame, instead of look_at [rad]"
    )
    field_of_view: float = Field(
        0.9, ge=0.05, le=2.8, description="angle from the lower to the upper edge of the picture [rad]"
    )
    # Width and height are even, because video formats need even numbers.
    width: int = Field(
        640, ge=16, le=3840, multiple_of=2, description="width of the pictures, after their rotation [pixels]"
    )
    height: int = Field(
        480, ge=16, le=2160, multiple_of=2, description="height of the pictures, after their rotation [pixels]"
    )
    rate: float = Field(30.0, gt=0, le=240, description="rate of the pictures [pictures/s]")
    exposure: float | None = Field(
        None, gt=0, le=1, description="time of exposure of a V4L2 device [s]; null: automatic"
    )
    rotation: Literal[0, 90, 180, 270] = Field(0, description="clockwise rotation of the pictures of a device [deg]")
    delay: float = Field(
        0.0,
        ge=0,
        le=2,
        description="time from capture to receipt of a picture, for a device without stamps of its own [s]",
    )
    depth: bool = Field(False, description="the depth of a RealSense camera is recorded too, without loss")
    repeat: bool = Field(True, description="a video file begins again at its end; false: the camera stops there")

    @model_validator(mode="after")
    def _has_one_source(self) -> CameraConfig:
        if self.topic is not None and self.device is not None:
            raise ValueError("allowed: either topic or device")
        if self.device is None:
            self._refuse(_DEVICE_KEYS, "with device, which is of a real camera")
        if self.topic is not None:
            self._refuse(("link", *_POSE_KEYS), "without topic, which is of a real camera")
        elif self.device is not None:
            self._refuse(_POSE_KEYS, "without device, which is of a real camera")
            if self.exposure is not None and self.device_kind != "v4l2":
                raise ValueError("exposure: allowed: of a V4L2 device")
            if self.depth and self.device_kind != "realsense":
                raise ValueError(f"depth: allowed: with device: {REALSENSE}SERIAL")
        else:
            self._check_pose()
        return self

    def _refuse(self, names: tuple[str, ...], allowed: str) -> None:
        default = {name: field.default for name, field in type(self).model_fields.items()}
        if given := [name for name in names if getattr(self, name) != default[name]]:
            raise ValueError(f"{', '.join(given)}: allowed: {allowed}")

    def _check_pose(self) -> None:
        if self.position is None:
            raise ValueError("allowed: position, or topic or device of a real camera")
        if (self.look_at is None) == (self.rpy is None):
            raise ValueError("allowed: either look_at or rpy")
        if self.look_at is not None:
            squares = sum((to - at) ** 2 for to, at in zip(self.look_at, self.position, strict=True))
            if squares < _LEAST_DISTANCE**2:
                raise ValueError("look_at is where the camera is: allowed: another point")

    @property
    def is_simulated(self) -> bool:
        return self.topic is None and self.device is None

    @property
    def device_kind(self) -> Literal["v4l2", "realsense", "address", "file"] | None:
        """The kind of the device; None if the camera is simulated or on a ROS topic."""
        if self.device is None:
            return None
        if isinstance(self.device, int) or self.device.isdigit() or self.device.startswith("/dev/"):
            return "v4l2"
        if self.device.startswith(REALSENSE):
            return "realsense"
        return "address" if "://" in self.device else "file"
