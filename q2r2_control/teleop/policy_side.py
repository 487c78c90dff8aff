"""Decide which arms follow a policy: arms that no operator drives, until the policy's actions end or have a fault."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pinocchio as pin

from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.events import Reason, ReasonKind
from q2r2_control.quaternions import floats_of, se3_of
from q2r2_control.teleop.arm import ArmTeleop
from q2r2_control.teleop.arm_states import AT_REST, ArmState, Cause
from q2r2_control.teleop.hand_motion import ArmMeasurements
from q2r2_control.teleop.policy_motion import PolicyMotion
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import ActionChunk, Array


class PolicySide:
    """Lets a policy drive the arms.

    After a fault, an arm whose hand has sent readings waits for a press. An arm without an operator continues with the
    next chunk that begins at the arm's tool pose. Linked arms begin together or not at all, since they may hold one
    object. The arms that have to begin together are the arms in the newest chunk, and the arms that a fault has stopped
    together.
    """

    def __init__(self, arms: Mapping[str, ArmTeleop], settings: TeleopSettings) -> None:
        self._arms = arms
        self._motions = {name: PolicyMotion(name, settings) for name in arms}
        self._told: dict[str, ReasonKind] = {}  # For each arm, why its last actions were refused.
        self._linked = settings.linked
        self._asked: set[str] = set()  # Arms for which the newest chunk has actions.
        self._stopped: set[str] = set()  # Linked arms that a fault has stopped together and that have not moved since.
        self.seen = False  # Whether a policy has sent anything in this run.

    def configure(self, settings: TeleopSettings) -> None:
        self._linked = settings.linked
        for motion in self._motions.values():
            motion.configure(settings)

    def update(
        self, chunks: Sequence[ActionChunk], around: ArmMeasurements, now: float, clock_fault: Reason | None
    ) -> None:
        """Take the chunks of one tick, and decide which arms follow the policy.

        An arm stops if its actions have ended or have a fault. If there is no fault, arms that may follow the policy
        begin to follow it.

        Args:
            chunks: The new chunks.
            around: The tool poses and the obstacles of this tick.
            now: The time [s].
            clock_fault: Why the loop's clock cannot be trusted, or None.
        """
        if chunks:
            self.seen = True
        elif not self.seen:
            return
        faults: dict[str, Reason] = {}
        for name, motion in self._motions.items():
            if motion.following and self._arms[name].state is not ArmState.POLICY:
                # The arm was stopped or taken over by a hand, so its chunk is forgotten. The arm may follow the next
                # chunk.
                motion.forget()
        for chunk in chunks:
            self._asked = {*chunk.tools, *chunk.motions} or self._asked
            for name, motion in self._motions.items():
                if fault := chunk.fault or motion.receive(chunk, now):
                    faults[name] = fault
        for name in self._in(ArmState.POLICY):
            ended = self._motions[name].advance(around.expected(name, None), now)
            if fault := clock_fault or faults.get(name) or ended:
                faults[name] = fault
        if faults:
            self._refuse(faults, now)
        else:
            self._begin(around, now)

    def _in(self, *states: ArmState) -> list[str]:
        return [name for name, arm in self._arms.items() if arm.state in states]

    def _refuse(self, faults: Mapping[str, Reason], now: float) -> None:
        """Stop the arms with faults. If an arm does not follow the policy, record a kind of fault only once."""
        following = self._in(ArmState.POLICY)
        for name, fault in faults.items():
            self._motions[name].forget()
            if name in following:
                self._arms[name].change(Cause.FAULT, now, fault)
            elif self._told.get(name) is not fault.kind:
                self._told[name] = fault.kind
                self._arms[name].record_event(now, Reason(TeleopReason.POLICY_REFUSED, cause=fault))
        first, fault = next(iter(faults.items()))
        if self._linked and not faults.keys().isdisjoint(following):
            self._stopped.update(following)
            for name in following:
                if name not in faults:
                    self._motions[name].forget()
                    self._arms[name].change(Cause.FAULT, now, Reason.of(TeleopReason.LINKED, cause=fault, arm=first))

    def _may_begin(self, name: str, around: ArmMeasurements) -> bool:
        arm = self._arms[name]
        if arm.state not in AT_REST or name in around.obstacles or around.anchor(name) is None:
            return False
        lost = self._in(ArmState.LOST) if self._linked else [name] if arm.state is ArmState.LOST else []
        return not any(self._arms[other].heard_of for other in lost)

    def _begin(self, around: ArmMeasurements, now: float) -> None:
        """Let each arm that has a plan and may follow it begin to do so. Linked arms begin together or not at all."""
        ready = [name for name in self._arms if self._may_begin(name, around) and self._motions[name].counts(now)]
        if not ready or (self._linked and not self._wanted().issubset(ready)):
            return
        tools = {name: around.expected(name, None) or floats_of(around.tools[name]) for name in ready}
        begun = {name: self._motions[name].begin(tools[name], now) for name in ready}
        faults = {name: fault for name, fault in begun.items() if fault is not None}
        if faults:
            self._refuse(faults, now)
        for name in ready:
            if faults and self._linked:
                self._motions[name].forget()
            elif name not in faults:
                self._told.pop(name, None)
                self._arms[name].offset = None  # Actions are targets for the controller, so no offset is added.
                self._arms[name].go(Cause.POLICY_ACTS, now, Reason(TeleopReason.POLICY_ACTS))

    def _wanted(self) -> set[str]:
        """Return the arms that have to begin together if arms are linked. Arms that move already are not among them."""
        self._stopped = {name for name in self._stopped if self._arms[name].state is ArmState.LOST}
        moved = self._in(ArmState.POLICY, ArmState.ENGAGED, ArmState.CARRIED)
        return (self._stopped | (self._asked & self._arms.keys())).difference(moved)

    def target(self, name: str, around: ArmMeasurements, now: float) -> pin.SE3:
        """Return the target of an arm that follows the policy, and set the opening of its gripper."""
        motion = self._motions[name]
        if (opening := motion.gripper(now)) is not None:
            self._arms[name].gripper = opening
        return se3_of(motion.target(around.expected(name, None), now))

    def posture(self, name: str, now: float) -> Array | None:
        """See :meth:`PolicyMotion.posture`."""
        return self._motions[name].posture(now)
