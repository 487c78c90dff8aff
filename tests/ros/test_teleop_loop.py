"""The nodes of both arms share one teleoperation, and go home at the request of the controller or of either hand."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest

from tests.ros.conftest import need_ros
from tests.ros.processes import as_arguments
from tests.support.reasons import kinds

need_ros()

from rclpy.parameter import Parameter
from rclpy.qos import ReliabilityPolicy

from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.errors import ConfigError
from q2r2_control.events import CommonReason, Reason
from q2r2_control.ros.bridge.teleop_loop import HomeClient
from q2r2_control.ros.nodes.arm_controllers import LeftArmController, RightArmController
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.teleop.teleop import Teleop


class WayHome:
    """The client of the services for homing, and a teleop layer. The test takes the role of the controller."""

    def __init__(self) -> None:
        self.teleop = Teleop(TeleopSettings(), ["left", "right"])
        self.services = {name: MagicMock() for name in ("home", "hold")}
        node = SimpleNamespace(create_client=lambda kind, name: self.services[name.rpartition("/")[2]])
        self._client: Any = HomeClient(node, "/c")

    def update(self, now: float, goes: bool, outcome: Reason | None = None) -> list[str]:
        """Update the client at ``now`` [s]. If ``goes`` is True, the controller reports that the arms go home.

        Return the events, each as the new state of an arm and the reason.
        """
        self._client.update(self.teleop, goes, outcome, now)
        return [f"{event.destination}: {kinds(event.reason)}" for event in self.teleop.take_events()]


@pytest.mark.parametrize(
    ("outcome", "event"),
    [
        (Reason(CommonReason.HOMING_ARRIVED), "paused: homing_arrived"),
        (Reason.of(CommonReason.HOMING_HELD_UP, by="a | b"), "paused: homing_held_up"),
        (Reason(CommonReason.HOMING_NO_WAY), "paused: homing_no_way"),
        (None, "lost: homing_fault: homing_ended"),
    ],
)
def test_homing_ends_with_the_outcome_that_the_controller_reports_or_else_with_a_fault(
    outcome: Reason | None, event: str
) -> None:
    way = WayHome()
    assert way.update(0.0, goes=True) == ["homing: homing"] * 2
    assert way.update(1.0, goes=False, outcome=outcome) == [event] * 2
    way.services["hold"].call_async.assert_not_called()


@pytest.mark.parametrize(
    ("answer", "event"),
    [
        (None, "lost: not_homing: no_answer"),
        ((False, "the controller is paused"), "lost: not_homing: other"),
        ((True, "done"), "lost: not_homing: homing_not_begun"),
    ],
)
def test_if_the_controller_does_not_begin_homing_the_homing_ends_with_a_fault(
    answer: tuple[bool, str] | None, event: str
) -> None:
    way = WayHome()
    future = way.services["home"].call_async.return_value
    future.done.return_value = answer is not None
    if answer is not None:
        future.result.return_value = SimpleNamespace(success=answer[0], message=answer[1])
    way.teleop.home(0.0)
    way.update(0.0, goes=False)
    way.services["home"].call_async.assert_called_once()
    assert (way.update(1.0, goes=False) or way.update(3.0, goes=False)) == [event] * 2


def test_a_pause_during_homing_makes_the_controller_hold() -> None:
    way = WayHome()
    way.update(0.0, goes=True)
    way.teleop.pause(0.5, Reason(TeleopReason.PAUSE_SERVICE))
    way.update(0.5, goes=True)
    way.services["hold"].call_async.assert_called_once()


@pytest.fixture
def both(context: Any) -> Iterator[tuple[LeftArmController, RightArmController]]:
    left = LeftArmController(context=context)
    right = RightArmController(context=context, partner=left)
    yield left, right
    for node in (right, left):
        node.destroy_node()


@pytest.mark.parametrize(("left", "right", "in_step"), [(1, 1, True), (1, 2, False), (None, None, False)])
def test_the_relative_pose_of_tools_is_corrected_only_if_both_references_have_the_same_stamp(
    left: int | None, right: int | None, in_step: bool, both: tuple[Any, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    loop, stamps = both[0].loop, {"left": left, "right": right}
    update = MagicMock(wraps=loop.teleop.update)
    for node in both:

        def begin(now: float, node: Any = node, begin_tick: Any = node.begin_tick) -> Reason | None:
            fault: Reason | None = begin_tick(now)
            node.inputs = node.inputs._replace(reference=stamps[node.arm_name])
            return fault

        monkeypatch.setattr(node, "begin_tick", begin)
    monkeypatch.setattr(loop.teleop, "update", update)
    loop.tick()
    assert update.call_args.kwargs["in_step"] is in_step


@pytest.mark.parametrize("given", ["mirror:=true", "rate:=125.0", "teleop.linked:=false", "mode:=filtered"])
def test_nodes_that_cannot_share_one_teleoperation_are_refused(given: str, context: object) -> None:
    left = LeftArmController(context=context)
    with pytest.raises(ConfigError, match=f"{given.split(':')[0].split('.')[0]}.* differ; allowed: the same in both"):
        RightArmController(context=context, partner=left, cli_args=as_arguments(given))
    left.destroy_node()


def test_a_parameter_of_the_teleoperation_that_is_set_in_one_node_is_set_in_both(both: tuple[Any, Any]) -> None:
    left, right = both
    for name, value in (("mirror", True), ("teleop.leash.distance", 0.05)):
        assert right.set_parameters([Parameter(name, value=value)])[0].successful
        assert left.get_parameter(name).value == value
    assert left.parameters.teleop == right.parameters.teleop == left.loop.teleop.settings
    assert (left.hand, right.hand) == ("right", "left")


def test_a_lost_report_does_not_delay_the_next_reports(both: tuple[Any, Any]) -> None:
    # A reliable subscription delivers in order. After a process was frozen, reports would wait 3 s for a lost report.
    reports = [one for node in both for one in node.subscriptions if one.topic_name.endswith("/state")]
    assert {one.topic_name for one in reports} == {"/cartesian_controller/state", "/recorder/state"}
    assert {one.qos_profile.reliability for one in reports} == {ReliabilityPolicy.BEST_EFFORT}
