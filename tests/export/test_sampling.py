"""Frames are evenly spaced in time. Each frame has the newest observation, and the first command that followed.

Each number in the features is the number that its name describes. A frame has the newest picture that was captured at
the time of the frame or before it.
"""

from __future__ import annotations

from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.recording import CameraConfig
from q2r2_control.errors import RecordingError
from q2r2_control.export.sampling import CameraFrames, features, sample
from q2r2_control.inputs.policy import MOTION_FIELDS
from q2r2_control.recording.reader import Recording
from q2r2_control.recording.tick_rows import NOT_MEASURED, POSE_FIELDS
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array
from tests.export.files import EPOCH, brightness, write_recording
from tests.support.processes import cell

pytestmark = pytest.mark.slow

MS = 1_000_000  # [ns]
CAMERA = CameraConfig(position=(1, 0, 1), rpy=(0, 0, 0), width=16, height=16, rate=50.0)
COUNT = 60


def recording(path: Path, times: list[int], **what: Any) -> Recording:
    """Return a recording with ticks at ``times`` [ms] since its start; see :func:`write_recording`."""
    return Recording(write_recording(path / "a.mcap", [MS * time for time in times], **what))


@pytest.mark.parametrize("fps", [1, 24, 30, 60, 200, 1000])
def test_a_frame_has_the_observations_of_the_newest_tick_and_the_commands_of_the_next_tick(
    fps: int, tmp_path: Path
) -> None:
    # The ticks are about a millisecond apart, and one of them is 70 ms late.
    steps = np.random.default_rng(0).integers(MS // 2, 3 * MS // 2, 1500)
    steps[750] += 70 * MS
    times = [int(time) for time in np.cumsum(steps)]
    frames = sample(Recording(write_recording(tmp_path / "a.mcap", times)), fps)
    k = 0
    while (due := times[0] + round(Fraction(k * 10**9, fps))) <= times[-1]:
        newest = max(place for place, time in enumerate(times) if time <= due)
        first = min(place for place, time in enumerate(times) if time >= due)
        assert frames["position"][k, 3] == -newest
        assert frames["velocity"][k, 3] == -10 * newest
        assert frames["effort"][k, 3] == -100 * newest
        assert frames["reference"][k, 3] == first
        assert frames["target"][k, 1, 0] == first
        assert frames["time"][k] == pytest.approx((due - times[0]) * 1e-9, abs=1e-12)
        k += 1
    assert {len(values) for values in frames.values()} == {k}


def test_the_operators_targets_are_used_where_they_exist_and_openings_belong_to_their_arms(tmp_path: Path) -> None:
    openings = {"wanted": (0.1, 0.4), "commanded": (0.2, 0.5), "opening": (0.3, 0.6)}
    frames = sample(recording(tmp_path, [*range(30)], engaged=range(5, 20), openings=openings), fps=1000)
    assert frames["target"][:, 0, 0].tolist() == [k + 1000 if 5 <= k < 20 else k for k in range(30)]
    assert frames["target"][:, 1, 0].tolist() == list(range(30))
    assert frames["gripper"].tolist() == [[0.2, 0.5]] * 30
    assert frames["opening"].tolist() == [[0.3, 0.6]] * 30


@pytest.mark.parametrize(
    ("engaged", "moving", "first", "last"),
    [
        pytest.param(range(12, 31), (), 12, 30, id="engaged"),
        pytest.param((), range(9, 22), 9, 21, id="moving"),
        pytest.param(range(12, 15), range(40, 43), 12, 42, id="with a pause in between"),
    ],
)
def test_trimmed_frames_begin_and_end_while_an_arm_is_engaged_or_moves(
    engaged: range, moving: range, first: int, last: int, tmp_path: Path
) -> None:
    whole = recording(tmp_path, [*range(60)], engaged=engaged, moving=moving)
    frames = sample(whole, fps=500, trim=True)
    assert frames["reference"][:, 0].tolist() == list(range(first, last + 1, 2))
    assert frames["time"][0] == 0.0
    assert len(sample(whole, fps=500)["time"]) == 30


LOSSY = [*range(20), *range(45, 65)]


@pytest.mark.parametrize(
    ("times", "numbers", "trim", "what"),
    [
        pytest.param([0, 1, 2], None, True, "no arm was ever engaged", id="nothing to trim to"),
        pytest.param(LOSSY, LOSSY, False, r"25 ticks were lost after 0\.019 s", id="lost for longer than a frame"),
        pytest.param([0, 2, 1], None, False, "damaged: ticks are not in the order of time", id="times that go back"),
        pytest.param([5, 4], None, False, "damaged: ticks are not in the order of time", id="that go back at once"),
        pytest.param([], None, False, "no tick was recorded", id="no tick"),
    ],
)
def test_a_recording_without_usable_ticks_has_no_frames(
    times: list[int], numbers: list[int] | None, trim: bool, what: str, tmp_path: Path
) -> None:
    with pytest.raises(RecordingError, match=rf"a\.mcap: {what}"):
        sample(recording(tmp_path, times, numbers=numbers), fps=60, trim=trim)


def test_ticks_that_were_lost_for_less_than_a_frame_are_not_an_error(tmp_path: Path) -> None:
    assert len(sample(recording(tmp_path, LOSSY, numbers=LOSSY), fps=30)["time"]) == 2


@cache
def robot() -> Robot:
    return Robot.from_config(cell())


def poses(q: Array) -> list[Array]:
    return [pin.SE3ToXYZQUAT(robot().tool_pose(q, arm)) for arm in robot().arms]


def frames(seed: int = 0) -> dict[str, Array]:
    """Return frames whose joints move through much of their range. The targets differ from the tool poses."""
    random = np.random.default_rng(seed)

    def motion() -> Array:
        ends = random.uniform(robot().position_lower, robot().position_upper, (2, len(robot().joint_names)))
        return np.linspace(ends[0], ends[1], COUNT)

    position, reference = motion(), motion()
    return {
        "position": position,
        "velocity": random.normal(size=position.shape),
        "effort": random.normal(size=position.shape),
        "opening": random.uniform(size=(COUNT, 2)),
        "reference": reference,
        "gripper": random.uniform(size=(COUNT, 2)),
        "target": np.array([poses(q) for q in motion()]),
        "reference_tool": np.array([poses(q) for q in reference]),
        "intervention": random.integers(2, size=(COUNT, 2)).astype(np.float64),
    }


def test_every_number_has_the_name_of_its_joint_or_gripper() -> None:
    given = frames()
    vectors, names = features(given, robot())
    grippers = [f"{arm}_gripper" for arm in robot().arms]
    for feature, labels, what in (
        ("observation.state", robot().joint_names, "position"),
        ("observation.velocity", robot().joint_names, "velocity"),
        ("observation.effort", robot().joint_names, "effort"),
        ("action", robot().joint_names, "reference"),
        ("observation.state", grippers, "opening"),
        ("action", grippers, "gripper"),
        ("intervention", list(robot().arms), "intervention"),
    ):
        columns = [names[feature].index(label) for label in labels]
        np.testing.assert_array_equal(vectors[feature][:, columns], given[what].astype(np.float32))


def test_observed_tool_poses_agree_with_the_measured_joint_positions() -> None:
    given = frames()
    vectors, names = features(given, robot())
    for arm in robot().arms:
        at = [names["observation.tool"].index(f"{arm}_{number}") for number in POSE_FIELDS]
        for q, pose in zip(given["position"], vectors["observation.tool"][:, at], strict=True):
            off = robot().tool_pose(q, arm).actInv(pin.XYZQUATToSE3(pose.astype(np.float64)))
            assert np.linalg.norm(pin.log6(off).vector) < 1e-5


def test_each_tool_delta_is_the_motion_from_a_target_to_the_next_one_and_the_last_delta_is_zero() -> None:
    vectors, names = features(frames(), robot())
    for arm in robot().arms:
        targets = vectors["action.tool"][:, [names["action.tool"].index(f"{arm}_{number}") for number in POSE_FIELDS]]
        at = [names["action.tool_delta"].index(f"{arm}_{number}") for number in MOTION_FIELDS]
        deltas = vectors["action.tool_delta"][:, at].astype(np.float64)
        places = [pin.XYZQUATToSE3(pose.astype(np.float64)) for pose in targets]
        for now, then, delta in zip(places, places[1:], deltas, strict=False):
            reached = now * pin.SE3(pin.exp3(delta[3:]), delta[:3])
            assert np.linalg.norm(pin.log6(then.actInv(reached)).vector) < 1e-4
        assert not deltas[-1].any()


def test_quaternions_keep_their_sign_between_frames_and_targets_have_the_same_sign_as_their_tools() -> None:
    flipped = 0
    for seed in range(5):
        given = frames(seed)
        vectors, names = features(given, robot())
        recorded = given["target"][..., 3:]
        flipped += int((np.sum(recorded[1:] * recorded[:-1], axis=-1) < 0.0).any())
        for arm in robot().arms:
            at = [names["action.tool"].index(f"{arm}_{number}") for number in POSE_FIELDS[3:]]
            tools, targets = vectors["observation.tool"][:, at], vectors["action.tool"][:, at]
            for quaternions in (tools, targets):
                assert (np.sum(quaternions[1:] * quaternions[:-1], axis=1) > 0.0).all()
            assert np.dot(tools[0], targets[0]) >= 0.0
            assert tools[0][np.abs(tools[0]).argmax()] > 0.0
    assert flipped  # Otherwise no quaternion was recorded with a changed sign, and the test would show nothing.


def test_grippers_that_are_never_measured_are_left_out() -> None:
    given = frames()
    given["opening"][:, 1] = NOT_MEASURED
    vectors, names = features(given, robot())
    assert names["observation.state"] == (*robot().joint_names, "left_gripper")
    assert vectors["observation.state"].shape == (COUNT, 15)
    given["opening"][:3, 0] = NOT_MEASURED
    with pytest.raises(RecordingError, match="the opening of arm left is not known at frame 0"):
        features(given, robot())


def test_a_number_that_is_not_finite_is_named_and_a_robot_that_is_not_the_recorded_robot_is_refused() -> None:
    given = frames()
    given["effort"][7, 2] = np.nan
    with pytest.raises(RecordingError, match=rf"observation.effort\[{robot().joint_names[2]}\] .* at frame 7"):
        features(given, robot())
    given["reference_tool"][:, 0, 2] += 1e-4
    with pytest.raises(RecordingError, match="not the recorded one"):
        features(given, robot())


def shown(path: Path, taken: list[int], frames: list[int]) -> list[int]:
    """Return the brightness of the picture of each frame. All times are in [ms] since the start."""
    pictures = {"front": [MS * time for time in taken]}
    of = recording(path, [*range(1, 200)], cameras={"front": CAMERA}, pictures=pictures)
    stamps = [EPOCH + MS * time for time in frames]
    return [round(float(pixels.mean())) for pixels in CameraFrames(of, "front", CAMERA, stamps)]


def test_a_frame_has_the_newest_picture_at_or_before_it(tmp_path: Path) -> None:
    found = shown(tmp_path, [1, 20, 40, 60, 80], [1, 19, 20, 21, 59, 60, 85, 120])
    assert found == [brightness(number) for number in (0, 0, 1, 1, 2, 3, 4, 4)]


@pytest.mark.parametrize(
    ("taken", "frames", "what"),
    [
        pytest.param([1, 20], [1, 60, 61], r"a picture 0\.041 s old at 0\.061 s", id="lost for more than two periods"),
        pytest.param([5], [4], r"no picture yet at 0\.004 s", id="taken later"),
        pytest.param([], [4], r"no picture yet at 0\.004 s", id="never taken"),
    ],
)
def test_a_frame_is_refused_if_its_newest_picture_is_too_old_or_no_picture_was_taken_before_it(
    tmp_path: Path, taken: list[int], frames: list[int], what: str
) -> None:
    with pytest.raises(RecordingError, match=rf"a\.mcap: camera front has {what}; allowed: at most two of its periods"):
        shown(tmp_path, taken, frames)


def test_a_picture_whose_size_is_not_the_size_of_its_camera_counts_as_damaged(tmp_path: Path) -> None:
    of = recording(tmp_path, [1], cameras={"front": CAMERA}, pictures={"front": [MS]})
    larger = CAMERA.model_copy(update={"width": 32})
    with pytest.raises(RecordingError, match=r"a\.mcap: damaged: a picture of camera front has a size"):
        next(iter(CameraFrames(of, "front", larger, [EPOCH + MS])))
