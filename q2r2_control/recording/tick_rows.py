"""Packs a tick into three parts: one row of float64 numbers, its samples, and its state as JSON.

The numbers of a row are in the order in which a tick computes them.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Sequence
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from q2r2_control.types import POSE_FIELDS, QUEST_CONTROLS, SIDES, Array, CommandMode, HandFault, HandSample, StepStatus

# The module is not imported at run time, because the process of the writer does not need the modules of the loop.
if TYPE_CHECKING:
    from q2r2_control.summary.tick import Tick

Rows = npt.NDArray[np.void]

NOT_MEASURED = -math.inf  # Stands for the opening of a gripper that the plant does not measure.
COMMAND_MODES, STATUSES = tuple(CommandMode), tuple(StepStatus)
HAND_FAULTS = (None, *HandFault)
# Largest stored bit mask of unsolved substeps. A float64 cannot store all larger integers.
UNSOLVED_MAX = 2**53
SAMPLE_FIELDS = (
    *("tick", "hand", "pose_stamp", "inputs_stamp", "x", "y", "z", "qx", "qy", "qz", "qw"),
    *QUEST_CONTROLS.names,
    "fault",
)
ARM_FIELDS = (
    *("opening", "engaged", "slip", "slip_angle", "wanted", "commanded", "rejected", "gripper_held", "holding"),
    *("intervention", "policy"),
)
# The poses of each arm in a row. ``tool`` is the tool pose at the reference. Zeros stand for a missing pose.
ARM_POSES = ("filtered_hand", "target", "tool")
# A replay does not compare these numbers: computing times vary, and ``tool`` is filled in only by the writer.
NOT_REPLAYED = ("compute_time", "solve_time", "tool")
_LOOP = ("index", "now", "dt", "connected", "following", "samples", "state_stamp", "external")
_MEASURED = ("q", "v", "tau", "tau_external")
_CONTROLLER = ("step", "unsolved", "status", "certified", "fallback", "closest_distance", "margin", "slack")
_DECIDED = ("reference_q", "reference_v", "reference_a", "command_q", "command_v", "command_tau")
_LAST = ("command_mode", "compute_time", "solve_time")

_values_of = attrgetter(*QUEST_CONTROLS.names)
_NO_POSE = (0.0,) * len(POSE_FIELDS)  # Stands for a missing pose. No pose has a quaternion of length 0.


class PackedTick(NamedTuple):
    """One tick, as it is sent to the process that writes it."""

    row: bytes  # A row with the dtype that tick_type returns.
    samples: bytes  # The float64 numbers of SAMPLE_FIELDS, sample after sample.
    state: str  # JSON of the state if it changed, or if there are events, chunks or extra controls; otherwise empty.

    @property
    def size(self) -> int:
        return len(self.row) + len(self.samples) + len(self.state)


def tick_type(arms: int, joints: int) -> np.dtype[np.void]:
    """Return the NumPy dtype of a row for these numbers of arms and joints; all its numbers are float64."""
    number, pose, of_joints = "<f8", f"({len(POSE_FIELDS)},)<f8", f"({joints},)<f8"
    arm = [*((name, number) for name in ARM_FIELDS), *((name, pose) for name in ARM_POSES)]
    return np.dtype(
        [
            *((name, number) for name in _LOOP),
            *((name, of_joints) for name in _MEASURED),
            ("arms", arm, (arms,)),
            *((name, number) for name in _CONTROLLER),
            *((name, of_joints) for name in _DECIDED),
            *((name, number) for name in _LAST),
        ]
    )


def tick_labels(arms: Sequence[str], joints: Sequence[str]) -> tuple[str, ...]:
    poses = [f"{name}.{number}" for name in ARM_POSES for number in POSE_FIELDS]
    names = [*_LOOP, *(f"{name}.{joint}" for name in _MEASURED for joint in joints)]
    names += [f"{arm}.{name}" for arm in arms for name in (*ARM_FIELDS, *poses)]
    names += [*_CONTROLLER, *(f"{name}.{joint}" for name in _DECIDED for joint in joints)]
    return (*names, *_LAST)


def numbers_in(rows: Rows) -> Array:
    """Return the rows (n,) as an array (n, k) of float64, where k is the count of numbers in a row."""
    return np.ascontiguousarray(rows).view(np.float64).reshape(len(rows), rows.dtype.itemsize // 8)


def targets_or_tools(rows: Rows) -> Array:
    """Return the operator's targets (n, arms, 7) as x y z [m] qx qy qz qw in the world.

    If an arm has no target, its tool pose at the reference is used instead.
    """
    targets, tools = rows["arms"]["target"], rows["arms"]["tool"]
    return np.where(targets.any(axis=2, keepdims=True), targets, tools)


class TickPacker:
    """Packs the ticks of one run, one after the other."""

    def __init__(self, arms: Sequence[str], joints: Sequence[str]) -> None:
        self._arms = tuple(arms)
        self._row = struct.Struct(f"<{len(tick_labels(arms, joints))}d")
        self._not_measured = [0.0] * len(joints)
        self._state: dict[str, Any] | None = None  # The last state that was packed.

    def repeat_state(self) -> None:
        """Let the next tick contain the state and the start of the run again. Call it if the previous tick was lost."""
        self._state = None

    def pack(self, number: int, tick: Tick) -> PackedTick:
        """Pack one tick. ``number`` counts the ticks from 0 on."""
        reference, state, command = tick.reference, tick.state, tick.command
        report, external = reference.report, state.tau_external
        samples = [sample for sample in tick.samples if sample.hand in SIDES] if tick.samples else []
        row = [number, tick.now, tick.dt, tick.connected, tick.following, len(samples), state.stamp]
        row += (external is not None, *state.q.tolist(), *state.v.tolist(), *state.tau.tolist())
        row += self._not_measured if external is None else external.tolist()
        for arm in self._arms:
            row += self._of_arm(arm, tick)
        row += (tick.step, min(report.unsolved, UNSOLVED_MAX), STATUSES.index(report.status), report.certified)
        row += (report.fallback, report.closest_distance, report.margin, report.slack)
        for joints in (reference.q, reference.v, reference.a, command.q, command.v, command.tau):
            row += joints.tolist()
        row += (COMMAND_MODES.index(command.mode), tick.compute_time, report.solve_time)
        packed_samples = b"".join([_packed_sample(number, sample) for sample in samples])
        return PackedTick(self._row.pack(*row), packed_samples, self._state_text(tick, samples))

    def _of_arm(self, arm: str, tick: Tick) -> tuple[float, ...]:
        target, opening = tick.targets[arm], tick.openings.get(arm, NOT_MEASURED)
        commanded = tick.command.grippers.get(arm, NOT_MEASURED)
        position, rotation = target.filtered_hand or (_NO_POSE[:3], _NO_POSE[3:])
        return (
            *(opening, tick.engaged[arm], target.slip, target.slip_angle, target.gripper, commanded),
            *(arm in tick.reference.report.rejected, arm in tick.held_grippers, tick.holding.get(arm, False)),
            *(tick.interventions.get(arm, False), tick.by_policy(arm)),
            *position,
            *rotation,
            *(_NO_POSE if target.command is None else pin.SE3ToXYZQUATtuple(target.command)),
            *_NO_POSE,
        )

    def _state_text(self, tick: Tick, samples: Sequence[HandSample]) -> str:
        """Return the state of a tick as JSON; the text is empty if nothing changed since the previous tick."""
        report = tick.reference.report
        state: dict[str, Any] = {
            "states": tick.states,
            "connected": tick.connected,
            "status": report.status,
            "closest_pair": report.closest_pair,
            "tightest_pair": report.tightest_pair,
            "held_grippers": tick.held_grippers,
            "holding": tick.holding,
        }
        more = [sample.inputs.more for sample in samples]
        if state == self._state and not tick.events and not tick.chunks and not any(more):
            return ""
        before, self._state = self._state, dict(state)
        if tick.chunks:
            state["chunks"] = [chunk.as_json() for chunk in tick.chunks]
        if tick.events:
            state["events"] = [event.as_json() for event in tick.events]
        if any(more):
            state["more_inputs"] = [{name: float(value) for name, value in of_hand.items()} for of_hand in more]
        if before is None:
            at_start = tick.start.state
            felt = None if at_start.tau_external is None else at_start.tau_external.tolist()
            joints = {"q": at_start.q.tolist(), "v": at_start.v.tolist(), "tau": at_start.tau.tolist()}
            state["start"] = {"now": tick.start.now, **joints, "tau_external": felt, "stamp": at_start.stamp}
        return json.dumps(state)


def _packed_sample(number: int, sample: HandSample) -> bytes:
    side, stamps = SIDES.index(sample.hand), (sample.pose_stamp, sample.inputs_stamp)
    pose, fault = (*sample.position.tolist(), *sample.quaternion.tolist()), HAND_FAULTS.index(sample.fault)
    values = (number, side, *stamps, *pose, *_values_of(sample.inputs), fault)
    return struct.pack(f"<{len(SAMPLE_FIELDS)}d", *values)
