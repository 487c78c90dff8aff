"""What the hands are to feel of their arms, from the built-in controller to the arms' nodes: ``~/condition/<arm>``.

One JSON object in a String: ``spare_distance`` [m], null where nothing is near; ``joints_at_limit``, their names;
``contact_force`` [N], null where it is not measured.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from rclpy.node import Node
from std_msgs.msg import String

from q2r2_control.ros.base_node import STREAM_QOS
from q2r2_control.teleop.haptics import ArmCondition
from q2r2_control.types import RobotState, StepReport

if TYPE_CHECKING:  # arms' nodes have no controller, and need not wait for its kernels
    from q2r2_control.loop.arm_conditions import ArmConditions

_PERIOD = 0.04  # [s]


class _Condition(BaseModel):
    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    spare_distance: float | None = None
    joints_at_limit: frozenset[str] = Field(frozenset(), max_length=100)
    contact_force: float | None = None


class ConditionPublishers:
    """Publishes the condition of each arm that somebody listens to."""

    def __init__(self, node: Node, arms: Any, conditions: ArmConditions) -> None:
        self._conditions = conditions
        self._publishers = {arm: node.create_publisher(String, f"~/condition/{arm}", STREAM_QOS) for arm in arms}
        self._due = -math.inf

    def update(self, report: StepReport, state: RobotState, now: float) -> None:
        """After a tick at ``now`` [s]."""
        self._conditions.note(report, now)
        if 0.0 <= self._due - now <= _PERIOD:
            return
        self._due = now + _PERIOD
        if not any(publisher.get_subscription_count() for publisher in self._publishers.values()):
            return
        for arm, felt in self._conditions.look(state, now).items():
            message = _Condition(
                spare_distance=felt.spare if math.isfinite(felt.spare) else None,
                joints_at_limit=felt.limits,
                contact_force=felt.force,
            )
            self._publishers[arm].publish(String(data=message.model_dump_json()))


def listen_to_condition(node: Node, controller: str, arm: str, notice: Callable[[ArmCondition], None]) -> None:
    """Call ``notice`` with what the controller of this name says of an arm."""

    def take(message: String) -> None:
        try:
            told = _Condition.model_validate_json(message.data)
        except ValidationError:
            return  # some other node's
        spare = math.inf if told.spare_distance is None else told.spare_distance
        notice(ArmCondition(spare, told.joints_at_limit, told.contact_force))

    node.create_subscription(String, f"{controller}/condition/{arm}", take, STREAM_QOS)
