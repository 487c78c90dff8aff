"""A held object is monitored. When it is gripped, each of its pairs keeps the distance that the pair has.

No arm therefore moves because an object is gripped. When a pair opens, it keeps a greater distance.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, Robot
from q2r2_control.types import Array
from q2r2_control.wording import limit_name
from tests.support.coal_distances import coal_distances
from tests.support.driven import Driven
from tests.support.object_cell import BLOCK, GRIP, at, cell

DT = 0.002
CELL = cell(BLOCK, BLOCK)


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.from_config(CELL)


@pytest.fixture(scope="module")
def controller(robot: Robot) -> CartesianController:
    return CartesianController(robot, CELL.control.timed(realtime=False))


@pytest.fixture(scope="module")
def at_grip(controller: CartesianController) -> Array:
    """Return a posture (nv,) [rad] in which the left tool rests where it can grip a block on the table."""
    return Driven(controller).drive(2.5, {"left": at(GRIP)}).q


def height(controller: CartesianController, arm: str = "left") -> float:
    return float(controller.tool_pose(arm).translation[2])


def counting(controller: CartesianController) -> Array:
    kept = controller.object_distances
    return kept[np.isfinite(kept)]


def object_distances(controller: CartesianController, q: Array) -> Array:
    """Return the distances of all pairs that contain an object (pairs,) [m], measured by Coal."""
    objects = controller.robot.objects
    return coal_distances(controller.robot, objects.geometry, q)[-len(objects.holders) :]


def test_no_arm_moves_when_a_block_on_the_table_is_gripped_or_released(
    controller: CartesianController, at_grip: Array
) -> None:
    run = Driven(controller, at_grip)
    for holds in (True, False):
        controller.set_holding("left", holds)
        reference = run.drive(0.2)
        assert np.abs(reference.q - at_grip).max() < 1e-9


def test_a_gripped_block_can_be_lifted_at_once_and_can_be_put_down_to_0_25_mm_above_the_table(
    controller: CartesianController, at_grip: Array
) -> None:
    run = Driven(controller, at_grip)
    controller.set_holding("left", True)
    assert -0.001 < counting(controller).min() < 0.0
    run.drive(0.5, {"left": at(GRIP + 0.02)})
    assert height(controller) == pytest.approx(GRIP + 0.02, abs=5e-4)
    assert counting(controller).min() == 0.0
    reference = run.drive(1.5, {"left": at(GRIP - 0.03)})
    assert height(controller) == pytest.approx(GRIP + 0.00025, abs=2e-4)
    assert any("left_object" in name for name in reference.report.closest_pair)
    assert reference.report.certified
    controller.set_holding("left", False)
    run.drive(1.0, {"left": at(GRIP - 0.015)})
    assert height(controller) == pytest.approx(GRIP - 0.015, abs=5e-4)


def test_the_margin_of_a_report_refers_to_the_distances_kept_at_that_tick(
    controller: CartesianController, at_grip: Array
) -> None:
    run = Driven(controller, at_grip)
    controller.set_holding("left", True)
    kept, grown = counting(controller).min(), 0
    for _ in range(100):
        reference = run.drive(DT, {"left": at(GRIP + 0.02)})
        distances = object_distances(controller, reference.q)
        spare = distances - controller.object_distances
        # In a penetration, Coal measures the depth in another way than the controller, so it is not compared.
        if distances[spare.argmin()] > 0.0:
            assert reference.report.margin == pytest.approx(spare.min(), abs=2e-6)
            grown += int(counting(controller).min() > kept)
        kept = counting(controller).min()
    assert grown > 0, "what the pair with the table keeps grows as the object is lifted"


@pytest.mark.slow
def test_if_an_object_overlaps_the_table_when_it_is_gripped_the_overlap_never_grows(robot: Robot) -> None:
    large = cell({"box": (0.04, 0.04, 0.08), "at": (0.0, 0.0, 0.013)})
    controller = CartesianController(Robot.from_config(large), large.control.timed(realtime=False))
    run = Driven(controller)
    start = run.drive(2.5, {"left": at(GRIP)}).q
    controller.set_holding("left", True)
    assert counting(controller).min() == pytest.approx(-0.01025, abs=5e-4)
    assert np.abs(run.drive(0.2).q - start).max() < 1e-4
    run.drive(0.5, {"left": at(GRIP - 0.01)})
    assert height(controller) > GRIP - 0.001
    run.drive(0.5, {"left": at(GRIP + 0.03)})
    assert counting(controller).min() == 0.0


def test_an_object_that_is_gripped_in_motion_keeps_its_new_distances_during_the_certified_stop(
    controller: CartesianController,
) -> None:
    """The tool moves down towards the table at 0.4 m/s. Coal measures the distances along the certified stop."""
    controller.reset(controller.robot.home)
    z = height(controller)
    while height(controller) > GRIP + 0.003:
        z -= 0.4 * DT
        reference = controller.step({"left": at(z)}, DT)
    assert np.abs(reference.v).max() > 0.05
    controller.set_holding("left", True)
    kept, stop = controller.object_distances, controller.stop_deceleration
    counts = np.isfinite(kept)
    for time in np.linspace(0.0, float((np.abs(reference.v) / stop).max()), 30):
        moving = np.minimum(time, np.abs(reference.v) / stop)
        q = reference.q + reference.v * moving - 0.5 * np.sign(reference.v) * stop * moving**2
        values = object_distances(controller, q)
        # In a penetration, Coal measures the depth in another way than the controller, so it is not compared.
        seen = counts & (values > 0.0)
        assert (values - kept)[seen].min() > -2e-6
        assert (kept[counts & (values <= 0.0)] < 0.0).all()
    for _ in range(500):
        report = controller.step({"left": at(0.2)}, DT).report
        assert report.certified
        assert report.margin >= 0.0
    assert height(controller) > GRIP - 0.031


@pytest.mark.slow
def test_an_arm_that_moves_a_held_bar_towards_the_other_arm_stops_at_the_kept_distance() -> None:
    long = cell({"box": (0.03, 0.25, 0.03)})
    controller = CartesianController(Robot.from_config(long), long.control.timed(realtime=False))
    others = np.array([any("right_" in name for name in pair) for pair in controller.robot.objects.pair_names()])
    nearest = []
    for holds in (False, True):
        run = Driven(controller)
        controller.set_holding("left", holds)
        reference = run.drive(2.5, {"left": at(0.55, -0.1)})
        nearest.append(float(object_distances(controller, reference.q)[others].min()))
    assert nearest[0] < 0.0
    assert 0.02 - 1e-6 < nearest[1] < 0.03


@pytest.mark.slow
def test_two_held_blocks_are_kept_apart_unless_they_overlap_when_the_second_block_is_gripped(
    controller: CartesianController,
) -> None:
    run = Driven(controller)
    for arm in ("left", "right"):
        controller.set_holding(arm, True)
    both = np.array([len(holders) == 2 for holders in controller.robot.objects.holders])
    assert np.isfinite(controller.object_distances[both]).all()
    reference = run.drive(3.0, {"left": at(0.45, 0.0), "right": at(0.45, 0.0)})
    assert object_distances(controller, reference.q)[both].min() > -1e-6
    bar = cell({"box": (0.02, 0.2, 0.02)}, {"box": (0.02, 0.2, 0.02)})
    controller = CartesianController(Robot.from_config(bar), bar.control.timed(realtime=False))
    run = Driven(controller)
    tilted = {
        arm: pin.SE3(pin.exp3(np.array([tilt, 0.0, 0.0])) @ at(0.0).rotation, np.array([0.5, y, 0.45]))
        for arm, tilt, y in (("left", -0.4, 0.06), ("right", 0.4, -0.06))
    }
    run.drive(2.5, tilted)
    for arm in ("left", "right"):
        controller.set_holding(arm, True)
    both = np.array([len(holders) == 2 for holders in controller.robot.objects.holders])
    assert not np.isfinite(controller.object_distances[both]).any()
    assert np.isfinite(controller.object_distances[~both]).all()
    run.drive(0.2, tilted)


@pytest.mark.slow
@pytest.mark.parametrize("forget", ["let go", "reset"])
def test_after_a_release_no_report_names_a_pair_of_the_object_even_if_no_time_passes(
    forget: str, controller: CartesianController, at_grip: Array
) -> None:
    run = Driven(controller, at_grip)
    controller.set_holding("left", True)
    run.drive(0.5, {"left": at(GRIP + 0.02)})
    binding = run.drive(1.5, {"left": at(GRIP - 0.03)}).report.binding
    assert any("left_object" in limit_name(limit) for limit in binding), "the block is held back by the table"
    assert controller.holding == {"left": True, "right": False}
    if forget == "reset":
        controller.reset(at_grip)
    else:
        controller.set_holding("left", False)
    assert controller.step({}, 0.0).report.binding == ()
    assert not any(controller.holding.values())
    assert not counting(controller).size


def test_if_a_step_is_undone_the_kept_distances_of_a_held_block_are_those_before_the_step(
    controller: CartesianController, at_grip: Array
) -> None:
    controller.reset(at_grip)
    lifted, grown = {"left": at(GRIP + 0.2)}, 0
    controller.set_holding("left", True)
    for _ in range(60):
        reference = controller.step(lifted, DT)
        before, distances = controller.object_distances, object_distances(controller, reference.q)
        late = controller.step(lifted, 0.1)
        grown += bool((counting(controller) > before[np.isfinite(before)]).any())
        controller.withdraw(late)
        np.testing.assert_array_equal(controller.object_distances, before)
        # In a penetration, Coal measures the depth in another way than the controller, so it is not compared.
        apart = distances > 0.0
        assert (distances[apart] >= controller.object_distances[apart] - 1e-6).all()
        assert controller.step(lifted, DT).report.certified
    assert grown > 10
