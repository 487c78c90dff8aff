"""The gate decides which poses may move an arm."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from q2r2_control.config.teleop import GateSettings
from q2r2_control.events import Reason
from q2r2_control.quaternions import se3_of
from q2r2_control.teleop.gate import PoseGate
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import HandFault
from tests.support.reasons import kinds
from tests.teleop.hands import pose, sample

GOOD = sample("left", pose(0.1, 0.2, 0.3, (0.1, 0.2, 0.3)), 1.0)


def gate() -> PoseGate:
    fresh = PoseGate(GateSettings())
    assert fresh.receive(GOOD, 1.0) == (True, None)
    return fresh


@pytest.mark.parametrize(
    "changes",
    [
        {"position": np.array([np.nan, 0, 0])},
        {"position": np.array([0, 0, 1e300])},
        {"position": np.zeros(2)},
        {"position": None},
        {"position": "here"},
        {"position": [10**400, 0, 0]},
        {"quaternion": np.zeros(4)},
        {"quaternion": np.array([0, 0, 0, 1e200])},
        {"quaternion": np.array([0, 0, 0, 1e-200])},
        {"quaternion": np.array([0, 0, 1.0])},
    ],
    ids=str,
)
def test_after_a_pose_without_finite_numbers_or_a_valid_rotation_the_gate_has_no_pose(
    changes: dict[str, object],
) -> None:
    passed = gate()
    usable, fault = passed.receive(replace(GOOD, pose_stamp=1.01, **changes), 1.01)  # type: ignore[arg-type]
    assert (usable, kinds(fault), passed.pose) == (False, "pose_unusable", None)


@pytest.mark.parametrize("factor", [-1.0, -1e-3])
def test_a_quaternion_of_either_sign_and_any_length_is_the_same_rotation(factor: float) -> None:
    passed = gate()
    assert passed.receive(replace(GOOD, quaternion=factor * GOOD.quaternion, pose_stamp=1.01), 1.01) == (True, None)
    assert passed.pose is not None
    expected = pose(0.1, 0.2, 0.3, (0.1, 0.2, 0.3))
    np.testing.assert_allclose(se3_of(passed.pose).homogeneous, expected.homogeneous, atol=1e-12)


@pytest.mark.parametrize(
    ("moved", "fault"),
    [
        (pose(0.24, 0.2, 0.3, (0.1, 0.2, 0.3)), None),
        (pose(0.26, 0.2, 0.3, (0.1, 0.2, 0.3)), "hand_jumped"),
        (pose(0.1, 0.2, 0.3, (0.1, 0.2, 1.2)), None),
        (pose(0.1, 0.2, 0.3, (0.1, 0.2, 1.6)), "hand_rotation_jumped"),
    ],
    ids=["a fast move passes", "a jump is a fault", "a fast turn passes", "a jump of the rotation is a fault"],
)
def test_a_jump_between_two_samples_is_a_fault_and_a_fast_motion_is_no_fault(moved: object, fault: str | None) -> None:
    usable, found = gate().receive(sample("left", moved, 1.013), 1.013)
    assert usable
    assert kinds(found) == (fault or "")


def test_the_watchdog_counts_from_the_receipt_of_a_pose_and_an_old_pose_does_not_reset_it() -> None:
    passed = gate()
    assert not passed.stale(1.15)
    passed.receive(GOOD, 1.14)
    assert passed.stale(1.1501)


def test_a_stamp_in_the_future_does_not_delay_the_watchdog() -> None:
    passed = gate()
    passed.receive(replace(GOOD, pose_stamp=1e6), 1.01)
    assert passed.stale(1.17)
    assert passed.receive(replace(GOOD, pose_stamp=1.02), 1.02) == (True, None)


def test_a_pose_that_arrives_after_a_newer_pose_is_ignored() -> None:
    passed = gate()
    assert passed.receive(sample("left", pose(9.0), 0.99), 1.01) == (False, None)
    assert passed.pose is not None
    assert passed.pose[0][0] == 0.1


def test_a_gap_between_two_poses_is_a_fault_even_if_the_watchdog_did_not_run_during_the_gap() -> None:
    assert kinds(gate().receive(replace(GOOD, pose_stamp=1.2), 1.2)[1]) == "pose_gap"


def test_samples_before_the_first_pose_are_no_fault_but_a_pose_stamp_of_nan_is_a_fault() -> None:
    fresh = PoseGate(GateSettings())
    assert fresh.receive(replace(GOOD, pose_stamp=-math.inf, quaternion=np.zeros(4)), 1.0) == (False, None)
    assert fresh.receive(replace(GOOD, pose_stamp=math.nan), 1.0)[1] is not None
    assert fresh.pose is None
    assert fresh.stale(1.0)


def faults_of_a_motion(speed: float, receipts: list[float], turning: bool = False) -> list[str]:
    """Return the fault of each sample of a hand with constant ``speed`` [m/s or rad/s]; "" if the sample has no fault.

    The hand is measured at 75 Hz, and the samples are received at the times ``receipts`` [s].
    """
    passed = PoseGate(GateSettings())
    found = []
    for index, stamp in enumerate(receipts):
        way = speed * index / 75.0
        moved = pose(turn=(0.0, 0.0, way)) if turning else pose(way)
        found.append(kinds(passed.receive(sample("left", moved, stamp), stamp)[1]))
    return found


EVEN = [index / 75.0 for index in range(60)]


@pytest.mark.parametrize(
    ("speed", "turning", "expected"),
    [(4.9, False, ""), (5.1, False, "hand_too_fast"), (29.0, True, ""), (31.0, True, "hand_turns_too_fast")],
    ids=["as fast as allowed", "faster", "turning as fast as allowed", "turning faster"],
)
def test_a_hand_that_moves_faster_than_any_operator_is_a_fault(speed: float, turning: bool, expected: str) -> None:
    assert max(faults_of_a_motion(speed, EVEN, turning)) == expected


@pytest.mark.parametrize("stall", [0.04, 0.08, 0.13])
def test_samples_that_a_network_delays_and_delivers_together_cause_no_speed_fault(stall: float) -> None:
    """The hand moves at 2 m/s. For ``stall`` [s] nothing arrives; then all samples of this time come, 0.1 ms apart.

    Successive samples are 27 mm apart.
    """
    end = EVEN[20] + stall
    receipts = [max(t, end + 1e-4 * (index - 20)) if t > EVEN[20] else t for index, t in enumerate(EVEN)]
    assert faults_of_a_motion(2.0, sorted(receipts)) == [""] * len(EVEN)


def test_a_jump_is_one_fault_and_causes_no_speed_fault_afterwards() -> None:
    passed = PoseGate(GateSettings(max_speed=1.0))
    for stamp in EVEN[:10]:
        passed.receive(sample("left", pose(), stamp), stamp)
    found = [passed.receive(sample("left", pose(0.5), stamp), stamp)[1] for stamp in EVEN[10:20]]
    assert kinds(found[0]) == "hand_jumped"
    assert found[1:] == [None] * 9


@pytest.mark.parametrize("fault", sorted(HandFault))
def test_after_a_sample_with_a_fault_of_the_input_the_gate_reports_this_fault_and_has_no_pose(fault: HandFault) -> None:
    passed = gate()
    assert passed.problem is None
    assert passed.receive(replace(GOOD, pose_stamp=1.01, fault=fault), 1.01) == (False, Reason(TeleopReason(fault)))
    assert (passed.pose, passed.problem) == (None, Reason(TeleopReason(fault)))
    assert not passed.stale(1.1)
    assert passed.receive(replace(GOOD, pose_stamp=1.02), 1.02) == (True, None)
    assert passed.problem is None
