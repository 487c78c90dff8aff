"""A tick as bytes: what the loop's own thread does for a recording, some microseconds of work.

A row of float64 has all that every tick has, in the order in which messages want it. What only some have goes behind
it: hand samples, the state in words where it changed, and at first where the run began.
"""

from __future__ import annotations

import json
import math
import pickle
import struct
from array import array
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pinocchio as pin

from q2r2_control.recording.topics import FLAGS, GRIPPERS, TICK, Topics
from q2r2_control.types import SIDES, CommandMode, HandInputs, HandSample, RobotState, StepStatus

if TYPE_CHECKING:  # the writer's process does without the loop's modules
    from q2r2_control.runtime.recorder import Tick

NOT_MEASURED = -math.inf  # in place of the opening of a gripper that the plant does not measure
COMMAND_MODES, STATUSES = tuple(CommandMode), tuple(StepStatus)
UNSOLVED_MAX = 2**53  # more substeps than a float64 has bits for cannot be told apart
JOINT_FIELDS = (
    *("q", "v", "tau", "tau_external", "reference_q", "reference_v", "reference_a"),
    *("command_q", "command_v", "command_tau"),
)
POSE = 7  # numbers of a pose: x y z qx qy qz qw

_MODE_NUMBERS = {mode: number for number, mode in enumerate(COMMAND_MODES)}
_STATUS_NUMBERS = {status: number for number, status in enumerate(STATUSES)}
_INPUTS = HandInputs.__slots__


class Extras(NamedTuple):
    """What only some ticks have; arrays are bytes of float64."""

    samples: bytes = b""  # rows of SAMPLE_FIELDS
    state: str = ""  # JSON
    start: bytes = b""  # of the topic run_start


_NOTHING = Extras()


def row_type(topics: Topics) -> np.dtype[np.void]:
    """The fields of a row; all of them are float64."""
    arms, joints = len(topics.arms), len(topics.joints)
    counts = {name: len(topics.by_name[name].labels["data"]) for name in (TICK, GRIPPERS, FLAGS)}
    fields: list[tuple[str, str, tuple[int, ...]]] = [(name, "<f8", (count,)) for name, count in counts.items()]
    fields += [("led", "<f8", (arms,)), ("targets", "<f8", (arms, POSE))]
    fields += [(name, "<f8", (joints,)) for name in JOINT_FIELDS]
    return np.dtype(fields)


def unpack(record: bytes, size: int) -> tuple[bytes, Extras]:
    """The row, of ``size`` bytes, and what is behind it."""
    return record[:size], Extras(*pickle.loads(record[size:])) if len(record) > size else _NOTHING


class TickPacker:
    """Packs the ticks of one run, one after the other."""

    def __init__(self, topics: Topics) -> None:
        self._arms = topics.arms
        kind = row_type(topics)
        assert kind.fields is not None
        self._row = bytearray(kind.itemsize)
        joints = np.frombuffer(self._row, dtype=kind)[0]
        self._joints = [joints[name] for name in JOINT_FIELDS]  # views of the row
        # Most of the numbers are by themselves, and numpy takes one as long as a whole list.
        self._numbers = struct.Struct(f"<{kind.fields['q'][1] // 8}d")
        self._state: tuple[Any, ...] | None = None  # as it was written last
        self._started = False

    def repeat_state(self) -> None:
        """Tell the state again with the next tick: the last one was lost."""
        self._state = None

    def pack(self, number: int, tick: Tick) -> bytes:
        """One tick, the ``number``-th from 0 on."""
        report, state, command, reference = tick.reference.report, tick.state, tick.command, tick.reference
        openings, commanded = tick.openings, command.grippers
        samples = [sample for sample in tick.samples if sample.hand in SIDES] if tick.samples else ()
        numbers: list[float] = [
            number,
            tick.now,
            tick.dt,
            tick.step,
            state.stamp,
            tick.following,
            tick.connected,
            len(samples),
            state.tau_external is not None,
            min(report.unsolved, UNSOLVED_MAX),
            _MODE_NUMBERS[command.mode],
            *(openings.get(arm, NOT_MEASURED) for arm in self._arms),
            tick.compute_time,
            report.solve_time,
        ]
        for arm in self._arms:
            gripper = tick.targets[arm].gripper
            numbers += (gripper, commanded.get(arm, NOT_MEASURED), openings.get(arm, NOT_MEASURED))
        numbers += (
            _STATUS_NUMBERS[report.status],
            report.certified,
            report.fallback,
            report.closest_distance,
            report.margin,
            report.slack,
        )
        for arm in self._arms:
            wanted = tick.targets[arm]
            held, holding = arm in tick.held_grippers, tick.holding.get(arm, False)
            numbers += (tick.engaged[arm], arm in report.rejected, wanted.slip, wanted.slip_angle, held, holding)
        poses = [tick.targets[arm].pose for arm in self._arms]
        numbers += [pose is not None for pose in poses]
        for pose in poses:
            numbers += _NO_POSE if pose is None else pin.SE3ToXYZQUATtuple(pose)
        self._numbers.pack_into(self._row, 0, *numbers)
        external = 0.0 if state.tau_external is None else state.tau_external
        measured, moved = (state.q, state.v, state.tau, external), (reference.q, reference.v, reference.a)
        for view, values in zip(self._joints, (*measured, *moved, command.q, command.v, command.tau), strict=True):
            view[:] = values
        return bytes(self._row) + self._extras(number, tick, samples)

    def _extras(self, number: int, tick: Tick, samples: Sequence[HandSample]) -> bytes:
        state, start = self._state_text(tick), b""
        if not self._started:
            self._started, begun = True, tick.start
            known = begun.state.tau_external is not None
            start = array("d", [begun.now, begun.state.stamp, known, *_joints(begun.state)]).tobytes()
        if not (samples or state or start):
            return b""
        rows = array("d", [value for sample in samples for value in _sample_row(number, sample)])
        return pickle.dumps(tuple(Extras(rows.tobytes(), state, start)))

    def _state_text(self, tick: Tick) -> str:
        """What has names, as JSON; empty where it is as it was."""
        report = tick.reference.report
        state = (
            tick.connected,
            report.status,
            report.closest_pair,
            report.tightest_pair,
            # Copies, since these change in place.
            tuple(tick.states.items()),
            tuple(tick.held_grippers.items()),
            tuple(tick.holding.items()),
        )
        if state == self._state and not tick.events:
            return ""
        self._state = state
        words: dict[str, Any] = {
            "states": tick.states,
            "connected": tick.connected,
            "status": report.status,
            "closest_pair": report.closest_pair,
            "tightest_pair": report.tightest_pair,
            "held_grippers": tick.held_grippers,
            "holding": tick.holding,
        }
        if tick.events:
            words["events"] = [asdict(event) for event in tick.events]
        return json.dumps(words)


_NO_POSE = (0.0,) * POSE


def _joints(state: RobotState) -> list[float]:
    """Positions, velocities, torques and external torques, zero where the plant cannot tell those."""
    external = np.zeros(len(state.q)) if state.tau_external is None else state.tau_external
    return [*state.q, *state.v, *state.tau, *external]


def _sample_row(number: int, sample: HandSample) -> list[float]:
    inputs = [getattr(sample.inputs, name) for name in _INPUTS]
    stamps = (sample.pose_stamp, sample.inputs_stamp)
    pose = (*sample.position.tolist(), *sample.quaternion.tolist())
    return [number, SIDES.index(sample.hand), *stamps, *pose, *inputs]
