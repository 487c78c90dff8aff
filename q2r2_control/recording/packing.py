"""A tick as bytes: what the loop's own thread does for a recording, some microseconds of work.

A row of float64 has all that every tick has, in the order in which messages want it. What only some have goes behind
it: hand samples, at first where the run began, and the state in words where it changed. Between two ticks other
programs and other code fill the processor's caches, so that little code here counts for more than little arithmetic.
"""

from __future__ import annotations

import json
import math
import struct
from array import array
from collections.abc import Sequence
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pinocchio as pin

from q2r2_control.recording.rows import Rows
from q2r2_control.recording.topics import FLAGS, GRIPPERS, SAMPLE_FIELDS, START, TICK, Topics
from q2r2_control.types import SIDES, Array, CommandMode, HandFault, HandInputs, HandSample, RobotState, StepStatus

if TYPE_CHECKING:  # the writer's process does without the loop's modules
    from q2r2_control.summary.tick import Tick

NOT_MEASURED = -math.inf  # in place of the opening of a gripper that the plant does not measure
COMMAND_MODES, STATUSES = tuple(CommandMode), tuple(StepStatus)
HAND_FAULTS = (None, *HandFault)
UNSOLVED_MAX = 2**53  # more substeps than a float64 has bits for cannot be told apart
JOINT_FIELDS = (
    *("q", "v", "tau", "tau_external", "reference_q", "reference_v", "reference_a"),
    *("command_q", "command_v", "command_tau"),
)
POSE = 7  # numbers of a pose: x y z qx qy qz qw

_MODE_NUMBERS = {mode: number for number, mode in enumerate(COMMAND_MODES)}
_STATUS_NUMBERS = {status: number for number, status in enumerate(STATUSES)}
_SAMPLE = struct.Struct(f"<{len(SAMPLE_FIELDS)}d")
_values_of = attrgetter(*HandInputs.__slots__)
_NO_POSE = (0.0,) * POSE  # whose quaternion is none


class PackedTicks(NamedTuple):
    """Some ticks in a row, unpacked."""

    rows: Rows  # of row_type
    samples: Array  # (samples, numbers of SAMPLE_FIELDS), of all of them
    start: bytes  # the numbers of the topic run_start, where the first tick of a run is among them
    states: list[str]  # of each: JSON where it changed, else empty


def row_type(topics: Topics) -> np.dtype[np.void]:
    """The fields of a row; all of them are float64."""
    arms, joints = len(topics.arms), len(topics.joints)
    counts = {name: len(topics.by_name[name].labels["data"]) for name in (TICK, GRIPPERS, FLAGS)}
    fields: list[tuple[str, str, tuple[int, ...]]] = [(name, "<f8", (count,)) for name, count in counts.items()]
    poses = [(name, "<f8", (arms, POSE)) for name in ("targets", "filtered_hands")]
    fields += [("led", "<f8", (arms,)), *poses, ("begins", "<f8", ())]
    fields += [(name, "<f8", (joints,)) for name in JOINT_FIELDS]
    return np.dtype(fields)


def unpack(batch: Sequence[bytes], topics: Topics) -> PackedTicks:
    """The ticks that :class:`TickPacker` packed."""
    kind, labels = row_type(topics), topics.by_name[TICK].labels["data"]
    rows = np.frombuffer(b"".join([record[: kind.itemsize] for record in batch]), dtype=kind)
    counts = rows[TICK][:, labels.index("samples")].astype(int).tolist()
    samples, start, states = [], b"", []
    for record, count, begins in zip(batch, counts, rows["begins"].tolist(), strict=True):
        end = kind.itemsize + count * _SAMPLE.size
        samples.append(record[kind.itemsize : end])
        if begins:
            start = record[end : end + 8 * len(topics.by_name[START].labels["data"])]
            end += len(start)
        states.append(record[end:].decode())
    return PackedTicks(rows, np.frombuffer(b"".join(samples)).reshape(-1, len(SAMPLE_FIELDS)), start, states)


class TickPacker:
    """Packs the ticks of one run, one after the other."""

    def __init__(self, topics: Topics) -> None:
        self._arms = topics.arms
        kind = row_type(topics)
        assert kind.fields is not None
        self._row = bytearray(kind.itemsize)
        first = kind.fields[JOINT_FIELDS[0]][1] // 8
        self._joints = np.frombuffer(self._row)[first:]  # a view of the row
        self._not_measured = np.zeros(len(topics.joints))
        # Most of the numbers are by themselves, and numpy takes one as long as a whole list.
        self._numbers = struct.Struct(f"<{first}d")
        self._state: tuple[Any, ...] | None = None  # in names, as it was told last
        self._begun = False

    def repeat_state(self) -> None:
        """Tell the state again with the next tick: the last one was lost."""
        self._state = None

    def pack(self, number: int, tick: Tick) -> bytes:
        """One tick, the ``number``-th from 0 on."""
        reference, state, command, holding = tick.reference, tick.state, tick.command, tick.holding
        report = reference.report
        samples = [sample for sample in tick.samples if sample.hand in SIDES] if tick.samples else []
        # Of all arms, one after the other.
        openings: list[float] = []
        grippers: list[float] = []
        flags: list[float] = []
        led: list[float] = []
        targets: list[float] = []
        hands: list[float] = []
        for arm in self._arms:
            target, opening = tick.targets[arm], tick.openings.get(arm, NOT_MEASURED)
            held, holds = arm in tick.held_grippers, holding.get(arm, False)
            openings.append(opening)
            grippers += (target.gripper, command.grippers.get(arm, NOT_MEASURED), opening)
            flags += (tick.engaged[arm], arm in report.rejected, target.slip, target.slip_angle, held, holds)
            asked = target.command
            led.append(asked is not None)
            targets += _NO_POSE if asked is None else pin.SE3ToXYZQUATtuple(asked)
            position, rotation = target.filtered_hand or (_NO_POSE[:3], _NO_POSE[3:])
            hands += *position, *rotation
        self._numbers.pack_into(
            self._row,
            0,
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
            *openings,
            tick.compute_time,
            report.solve_time,
            *grippers,
            _STATUS_NUMBERS[report.status],
            report.certified,
            report.fallback,
            report.closest_distance,
            report.margin,
            report.slack,
            *flags,
            *led,
            *targets,
            *hands,
            not self._begun,
        )
        external = self._not_measured if state.tau_external is None else state.tau_external
        measured, moved = (state.q, state.v, state.tau, external), (reference.q, reference.v, reference.a)
        np.concatenate((*measured, *moved, command.q, command.v, command.tau), out=self._joints)
        record = bytes(self._row)
        for sample in samples:
            record += _packed_sample(number, sample)
        if not self._begun:
            self._begun = True
            record += _packed_start(tick.start.now, tick.start.state)
        words = (tick.connected, report.status, report.closest_pair, report.tightest_pair)
        named = (*words, tick.states, tick.held_grippers, holding)
        if named != self._state or tick.events:
            self._state = named
            record += _state_text(tick).encode()
        return record


def _state_text(tick: Tick) -> str:
    """What has names, as JSON."""
    report = tick.reference.report
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
        words["events"] = [event.as_json() for event in tick.events]
    return json.dumps(words)


def _packed_start(now: float, state: RobotState) -> bytes:
    """Where a run began; external torques are zero where the plant cannot tell them."""
    external = np.zeros(len(state.q)) if state.tau_external is None else state.tau_external
    known = state.tau_external is not None
    return array("d", [now, state.stamp, known, *state.q, *state.v, *state.tau, *external]).tobytes()


def _packed_sample(number: int, sample: HandSample) -> bytes:
    side, stamps = SIDES.index(sample.hand), (sample.pose_stamp, sample.inputs_stamp)
    pose, fault = (*sample.position.tolist(), *sample.quaternion.tolist()), HAND_FAULTS.index(sample.fault)
    return _SAMPLE.pack(number, side, *stamps, *pose, *_values_of(sample.inputs), fault)
