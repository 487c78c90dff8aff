"""Joint states are a fault if they are late, old or not finite, or jump. Arms of other controllers may lag farther."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control import load_config
from q2r2_control.config.control import SupervisionSettings
from q2r2_control.events import CommonReason, Reason, ReasonKind
from q2r2_control.ros.reasons import RosReason
from q2r2_control.supervision.joint_watch import JointWatch, settings_for_external_arms, watch_settings
from q2r2_control.supervision.reasons import SupervisionReason
from q2r2_control.types import RobotState
from q2r2_control.wording import sentence
from tests.supervision.conftest import CONFIG

NAMES, LIMIT = ("shoulder", "elbow"), np.array([1.0, 2.0])  # Names of joints, and their velocity limits [rad/s].
SETTINGS = SupervisionSettings()
PERIOD = 0.01  # Period of the states [s].


def state(q: float, stamp: float, v: float = 0.0, external: float | None = None) -> RobotState:
    torque = None if external is None else np.array([0.0, external])
    return RobotState(q=np.array([0.0, q]), v=np.array([0.0, v]), tau=np.zeros(2), stamp=stamp, tau_external=torque)


class Joints:
    """A watch that has accepted resting arms. The newest state came at the time ``now`` [s]."""

    def __init__(self, settings: SupervisionSettings = SETTINGS) -> None:
        self.watch = JointWatch(NAMES, LIMIT, watch_settings(settings, yields=False), lambda: " from /arm")
        self.now = 0.0
        self.rest(settings.settle_time + 2.0 * PERIOD)
        assert self.watch.settled(self.now)
        self.watch.accept()

    def rest(self, duration: float, q: float = 0.0) -> None:
        end = self.now + duration
        while self.now < end:
            self.now += PERIOD
            self.watch.observe(state(q, self.now), self.now)

    def fault(self) -> ReasonKind | None:
        found = self.watch.check(self.now)
        return None if found is None else found.kind


@pytest.fixture
def joints() -> Joints:
    return Joints()


def test_no_fault_is_found_while_states_come_and_the_arms_rest(joints: Joints) -> None:
    joints.rest(1.0)
    assert joints.fault() is None
    assert joints.watch.believed


def test_missing_joint_states_are_a_fault_after_the_timeout(joints: Joints) -> None:
    joints.now += SETTINGS.state_timeout - 1e-6
    assert joints.fault() is None
    joints.now += 2e-6
    assert joints.fault() is SupervisionReason.STATES_SILENT
    assert not joints.watch.believed
    fault = joints.watch.check(joints.now)
    assert fault is not None
    assert sentence(fault) == f"no joint states from /arm for 0.100 s; allowed: {SETTINGS.state_timeout:g}"


def test_a_clock_that_was_set_back_by_more_than_the_timeout_is_a_fault(joints: Joints) -> None:
    joints.now -= SETTINGS.state_timeout - 1e-6
    assert joints.fault() is None
    joints.now -= 2e-6
    assert joints.fault() is SupervisionReason.STATES_SILENT


def test_the_first_fault_stays_until_states_are_accepted_again(joints: Joints) -> None:
    joints.watch.observe(Reason.of(RosReason.BAD_JOINT_STATES, text="elbow is missing"), joints.now)
    joints.watch.observe(Reason.of(CommonReason.LOOP_STALLED, duration=1.0), joints.now)
    assert joints.fault() is RosReason.BAD_JOINT_STATES
    joints.rest(SETTINGS.settle_time + 2.0 * PERIOD)
    assert joints.watch.settled(joints.now)
    joints.watch.accept()
    assert joints.fault() is None


@pytest.mark.parametrize("what", ["position", "velocity", "external torque"])
def test_states_with_a_number_that_is_not_finite_are_ignored_for_50_ms_and_then_reported(
    joints: Joints, what: str
) -> None:
    bad = {
        "position": lambda stamp: state(np.nan, stamp),
        "velocity": lambda stamp: state(0.0, stamp, v=np.inf),
        "external torque": lambda stamp: state(0.0, stamp, external=np.nan),
    }[what]
    good = joints.now
    while joints.now < good + SETTINGS.unusable_time - PERIOD:
        joints.now += PERIOD
        joints.watch.observe(bad(joints.now), joints.now)
        assert joints.fault() is None
    assert joints.watch.state is not None
    assert joints.watch.state.stamp == good
    joints.now = good + SETTINGS.unusable_time + 1e-6
    joints.watch.observe(bad(joints.now), joints.now)
    fault = joints.watch.fault
    assert fault is not None
    assert (fault.kind, fault.detail["quantity"], fault.detail["joint"]) == (
        SupervisionReason.STATE_NOT_FINITE,
        what,
        "elbow",
    )
    assert sentence(fault).endswith(" for more than 50 ms; allowed: finite numbers")


@pytest.mark.parametrize("gap", [PERIOD, 0.05])
def test_a_joint_that_moves_farther_than_its_speed_allows_is_a_fault(gap: float) -> None:
    """The elbow may move at 2 rad/s during the gap and for 20 ms more, plus 50 mrad."""
    allowed = 2.0 * (gap + 0.02) + 0.05
    for distance, expected in ((allowed - 1e-6, None), (allowed + 1e-6, SupervisionReason.STATE_JUMPED)):
        joints = Joints()
        joints.now += gap
        joints.watch.observe(state(distance, joints.now), joints.now)
        assert joints.fault() is expected


def test_the_joint_that_jumped_is_named_even_if_a_joint_with_a_higher_limit_moved_farther(joints: Joints) -> None:
    joints.now += PERIOD
    zero = np.zeros(2)
    joints.watch.observe(RobotState(np.array([0.1, 0.105]), zero, zero, None, joints.now), joints.now)
    assert joints.watch.fault is not None
    assert sentence(joints.watch.fault) == "shoulder jumped by 0.100 rad"


def test_a_joint_may_move_farther_if_more_simulated_time_than_loop_time_has_passed(joints: Joints) -> None:
    joints.now += PERIOD
    joints.watch.observe(state(0.4, joints.now), joints.now, passed=0.2)
    assert joints.fault() is None


def test_creeping_arms_are_not_settled_and_resting_arms_are_settled_after_the_settle_time() -> None:
    watch, now = JointWatch(NAMES, LIMIT, watch_settings(SETTINGS, yields=False)), 0.0
    while now < 3.0 * SETTINGS.settle_time:
        now += PERIOD
        watch.observe(state(0.15 * now, now), now)
        assert not watch.settled(now), "it moves by 10 mrad within the settle time"
    still = now
    while now < still + SETTINGS.settle_time + PERIOD:
        now += PERIOD
        watch.observe(state(0.15 * still, now), now)
    assert watch.settled(now)
    assert not watch.settled(now + SETTINGS.state_timeout + 1e-6), "the newest state is too old"


def test_if_their_session_is_lost_arms_may_brake_from_joint_states_that_still_arrive(joints: Joints) -> None:
    joints.watch.lose(Reason.of(CommonReason.LOOP_STALLED, duration=1.0))
    assert joints.fault() is CommonReason.LOOP_STALLED
    assert joints.watch.believed
    joints.now += PERIOD
    joints.watch.observe(state(np.pi, joints.now), joints.now)
    joints.now += PERIOD
    joints.watch.observe(state(-np.pi, joints.now), joints.now)
    assert not joints.watch.believed


def test_if_arms_lose_their_session_during_another_fault_they_may_not_brake_from_their_states(joints: Joints) -> None:
    joints.watch.observe(Reason.of(RosReason.BAD_JOINT_STATES, text="elbow is missing"), joints.now)
    joints.watch.lose(Reason.of(CommonReason.LOOP_STALLED, duration=1.0))
    assert not joints.watch.believed


def test_a_joint_away_from_its_reference_is_named_after_the_deviation_time(joints: Joints) -> None:
    near = np.array([0.0, SETTINGS.max_deviation])
    far = near + np.array([0.0, 1e-6])
    assert joints.watch.deviates(near, joints.now) is None
    began = joints.now
    assert joints.watch.deviates(far, began + SETTINGS.deviation_time) is None
    reason = joints.watch.deviates(far, began + SETTINGS.deviation_time + 1e-6)
    assert reason is not None
    assert sentence(reason) == "elbow is 0.150 rad from its reference for 0.5 s; allowed: 0.15 rad for 0.5 s"
    assert joints.watch.deviates(near, began + 1.0) is None, "it is near again"
    assert joints.watch.deviates(far, began + 1.0 + SETTINGS.deviation_time) is None


def test_compliant_arms_may_deviate_farther_from_their_reference() -> None:
    assert watch_settings(SETTINGS, yields=True).deviation == SETTINGS.max_deviation_torque
    assert watch_settings(SETTINGS, yields=False).deviation == SETTINGS.max_deviation


def test_settings_for_external_arms_turn_admittance_off_and_allow_a_larger_deviation() -> None:
    config = load_config(CONFIG)
    config = config.model_copy(update={"admittance": config.admittance.model_copy(update={"enabled": True})})
    external = settings_for_external_arms(config)
    assert not external.admittance.enabled
    assert external.supervision.max_deviation == config.supervision.max_deviation_external
    assert external.control.posture_gain > config.control.posture_gain
