from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.targets import TargetTracker, TaskTargets, update_targets
from q2r2_control.types import Array
from tests.control.cells import kernel_model

ARMS = ("left", "right")
STILL = np.zeros(14)
SETTINGS = ControllerSettings(feed_forward_time=0.02)


@pytest.fixture
def tracker() -> TargetTracker:
    made = TargetTracker(kernel_model("dual_iiwa7").tasks, ARMS, SETTINGS)
    made.reset(STILL)
    return made


def _taken(tracker: TargetTracker) -> TaskTargets:
    return tracker._targets  # There is no public access, because ``pointer`` is for kernels only.


def _update(tracker: TargetTracker, targets: dict[str, Any], dt: float, q: Array, v: Array) -> tuple[str, ...]:
    """Give the tracker new targets. Return the names whose target is not usable, including unknown names."""
    known = tracker.offer(targets)
    return () if update_targets(_taken(tracker), q, v, dt) and known else tracker.rejected(targets)


def _pose(rotation: Array | None = None, translation: Array | None = None) -> pin.SE3:
    return pin.SE3(
        np.eye(3) if rotation is None else rotation, np.array([0.5, 0.0, 0.4]) if translation is None else translation
    )


def _with(position: tuple[int, int], value: float) -> pin.SE3:
    pose = _pose()
    homogeneous = pose.homogeneous.copy()
    homogeneous[position] = value
    return pin.SE3(homogeneous[:3, :3].copy(), homogeneous[:3, 3].copy())


UNUSABLE: dict[str, Callable[[], Any]] = {
    "NaN in the translation": lambda: _with((1, 3), np.nan),
    "NaN in the rotation": lambda: _with((2, 1), np.nan),
    "infinities that cancel": lambda: _pose(None, np.array([np.inf, -np.inf, 0.0])),
    "a rotation of zeros": lambda: _pose(np.zeros((3, 3))),
    "a reflection": lambda: _pose(np.diag([1.0, -1.0, 1.0])),
    "a sheared rotation": lambda: _pose(np.array([[1.0, 0.01, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])),
    "a rotation too large to square": lambda: _pose(np.full((3, 3), 1e200)),
    "text": lambda: "left",
    "a twist": lambda: pin.Motion.Zero(),
}


@pytest.mark.parametrize("bad", UNUSABLE.values(), ids=UNUSABLE.keys())
def test_a_target_that_is_not_a_pose_is_named_and_the_last_target_stays(
    tracker: TargetTracker, bad: Callable[[], Any]
) -> None:
    good = _pose(pin.exp3(np.array([0.1, 0.2, 0.3])))
    assert _update(tracker, {"left": good, "right": good}, 0.001, STILL, STILL) == ()
    assert _update(tracker, {"left": bad(), "right": good}, 0.001, STILL, STILL) == ("left",)
    taken = _taken(tracker)
    np.testing.assert_allclose(taken.rotation[0], good.rotation, atol=1e-12)
    np.testing.assert_array_equal(taken.translation[0], good.translation)
    np.testing.assert_array_equal(taken.follows, [1, 1])
    assert np.isfinite(taken.feed_forward).all()


def test_a_target_of_an_unknown_arm_is_named(tracker: TargetTracker) -> None:
    assert _update(tracker, {"left": _pose(), "third": _pose()}, 0.001, STILL, STILL) == ("third",)


@pytest.mark.parametrize("far", [150.0, 1e307], ids="{:g} m".format)
def test_a_target_far_beyond_any_cell_is_moved_nearer_in_the_same_direction(tracker: TargetTracker, far: float) -> None:
    assert _update(tracker, {"left": _pose(None, far * np.array([1.0, -0.5, 0.25]))}, 0.001, STILL, STILL) == ()
    np.testing.assert_allclose(_taken(tracker).translation[0], [100.0, -50.0, 25.0])


def test_a_slightly_skewed_rotation_matrix_is_made_orthonormal(tracker: TargetTracker) -> None:
    random = np.random.default_rng(36)
    for _ in range(20):
        R = pin.exp3(random.normal(size=3))
        _update(tracker, {"left": _pose(R + random.uniform(-1e-4, 1e-4, (3, 3)))}, 0.001, STILL, STILL)
        taken = _taken(tracker).rotation[0]
        np.testing.assert_allclose(taken @ taken.T, np.eye(3), atol=1e-6)
        np.testing.assert_allclose(taken, R, atol=1e-3)


def _moved(start: pin.SE3, twist: Array, t: float) -> pin.SE3:
    return pin.SE3(pin.exp3(twist[3:] * t) @ start.rotation, start.translation + twist[:3] * t)


@pytest.mark.parametrize("dt", [0.0005, 0.005, 0.1], ids="dt {} s".format)
def test_the_feed_forward_velocity_of_a_moving_target_becomes_equal_to_its_twist(
    tracker: TargetTracker, dt: float
) -> None:
    twist = np.array([0.2, -0.1, 0.05, 0.5, -0.3, 0.8])
    start = _pose(pin.exp3(np.array([1.0, -0.5, 0.2])))
    for tick in range(1 + int(np.ceil(0.5 / dt))):
        _update(tracker, {"left": _moved(start, twist, tick * dt)}, dt, STILL, STILL)
    np.testing.assert_allclose(_taken(tracker).feed_forward[0], twist, atol=1e-6)
    np.testing.assert_array_equal(_taken(tracker).feed_forward[1], 0.0)


TELEPORTS = {
    "by half a turn": _pose(pin.exp3(np.array([0.0, 0.0, 3.0]))),
    "beyond any cell": _pose(None, np.array([1e6, 0.0, 0.0])),
}


@pytest.mark.parametrize("elsewhere", TELEPORTS.values(), ids=TELEPORTS.keys())
def test_a_target_that_jumps_gets_no_feed_forward_velocity(tracker: TargetTracker, elsewhere: pin.SE3) -> None:
    for pose in (_pose(), elsewhere, elsewhere):
        _update(tracker, {"left": pose}, 0.001, STILL, STILL)
        np.testing.assert_array_equal(_taken(tracker).feed_forward[0], 0.0)


def test_the_first_target_after_a_hold_or_a_reset_gets_no_feed_forward_velocity(tracker: TargetTracker) -> None:
    nearby = _pose(None, np.array([0.5005, 0.0, 0.4]))
    for forget in (lambda: _update(tracker, {}, 0.001, STILL, STILL), lambda: tracker.reset(STILL)):
        _update(tracker, {"left": _pose()}, 0.001, STILL, STILL)
        forget()
        _update(tracker, {"left": nearby}, 0.001, STILL, STILL)
        np.testing.assert_array_equal(_taken(tracker).feed_forward[0], 0.0)


@pytest.mark.parametrize("dt", [0.0, -0.001], ids=["no time", "time backwards"])
def test_a_target_gets_no_feed_forward_velocity_if_no_time_passes(tracker: TargetTracker, dt: float) -> None:
    for x in (0.5, 0.6):
        assert _update(tracker, {"left": _pose(None, np.array([x, 0.0, 0.4]))}, dt, STILL, STILL) == ()
        assert np.isfinite(_taken(tracker).feed_forward).all()
    np.testing.assert_array_equal(_taken(tracker).feed_forward[0], 0.0)


@pytest.mark.parametrize("absent", [{}, {"left": None}], ids=["missing", "None"])
def test_an_arm_without_a_target_brakes_and_holds_the_posture_where_it_comes_to_rest(
    tracker: TargetTracker, absent: dict[str, Any]
) -> None:
    _update(tracker, {"left": _pose(), "right": _pose()}, 0.001, STILL, STILL)
    left = np.arange(14) < 7
    q = STILL.copy()
    for speed in (1.0, 0.5, 0.1, 0.0):
        q = q + 0.1
        _update(tracker, {"right": _pose()} | absent, 0.001, q, np.where(left, speed, 1.0))
        np.testing.assert_allclose(_taken(tracker).hold[left], q[left])
    assert _taken(tracker).follows.tolist() == [0, 1]
    for push in (0.01, 0.02):
        _update(tracker, {"right": _pose()} | absent, 0.001, q + push, STILL)
        np.testing.assert_allclose(_taken(tracker).hold[left], q[left], err_msg="pushed aside it goes back")


def test_after_a_reset_every_arm_holds_its_posture(tracker: TargetTracker) -> None:
    _update(tracker, {"left": _pose(), "right": _pose()}, 0.001, STILL, STILL)
    tracker.reset(np.linspace(-1, 1, 14))
    assert _taken(tracker).follows.tolist() == [0, 0]
    np.testing.assert_array_equal(_taken(tracker).hold, np.linspace(-1, 1, 14))
