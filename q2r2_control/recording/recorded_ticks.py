"""The ticks of a recording, with all that each of them took and what reference came of it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from q2r2_control.errors import RecordingError
from q2r2_control.events import Event
from q2r2_control.recording import topics as names
from q2r2_control.recording.episode_spans import events_of_ticks
from q2r2_control.recording.packing import HAND_FAULTS, NOT_MEASURED
from q2r2_control.recording.reader import RecordedChunk, Recording
from q2r2_control.summary.tick import RunStart
from q2r2_control.types import SIDES, Array, HandInputs, HandSample, RobotState


@dataclass(frozen=True, slots=True)
class RecordedTick:
    """What one tick took, and the reference that came of it."""

    number: int
    now: float
    dt: float
    following: bool
    connected: bool
    samples: list[HandSample]
    state: RobotState
    openings: dict[str, float]
    unsolved: int
    events: list[Event]
    reference_q: Array  # (nv,) [rad]
    reference_v: Array  # (nv,) [rad/s]
    grippers: dict[str, float]  # openings that were wanted


class RecordedTicks:
    """The ticks of a recording, one after the other. Ends before the first that is missing."""

    def __init__(self, recording: Recording, expect: Callable[[RecordedChunk], None] = lambda chunk: None) -> None:
        """``expect`` gets each chunk of messages before its first tick is given."""
        self._arms, self._joints = recording.about.arms, len(recording.about.joints)
        self._labels = recording.topics.by_name[names.TICK].labels["data"]
        self._wanted = [
            recording.topics.by_name[names.GRIPPERS].labels["data"].index(f"wanted_{arm}") for arm in self._arms
        ]
        self._expect = expect
        self._chunks = recording.chunks()
        self._ticks = self._all()
        self._starts: list[RunStart] = []
        self.missing = 0  # ticks that were lost behind the last one
        self.count = 0
        self.current: RecordedTick | None = None
        self.next = next(self._ticks, None)
        if self.next is None or not self._starts:
            raise RecordingError(f"{recording.file}: no tick was recorded")
        self.start = self._starts[0]

    def advance(self) -> RecordedTick:
        """Go on to the next tick. Raises :class:`NoMoreTicksError` behind the last."""
        if self.next is None:
            raise NoMoreTicksError
        self.current, self.next = self.next, next(self._ticks, None)
        self.count += 1
        return self.current

    def _all(self) -> Iterator[RecordedTick]:
        expected = 0
        for chunk in self._chunks:
            self._expect(chunk)
            if names.START in chunk.rows:
                self._starts.append(self._start_of(chunk))
            for tick in self._ticks_of(chunk):
                if tick.number != expected:
                    self.missing = tick.number - expected
                    return
                yield tick
                expected += 1

    def _start_of(self, chunk: RecordedChunk) -> RunStart:
        now, stamp, external, *joints = chunk.rows[names.START]["data"][0].tolist()
        q, v, tau, felt = np.array(joints).reshape(4, self._joints)
        return RunStart(now, RobotState(q, v, tau, felt if external else None, stamp))

    def _ticks_of(self, chunk: RecordedChunk) -> Iterator[RecordedTick]:
        if names.TICK not in chunk.rows:
            return
        states = chunk.rows[names.JOINT_STATES]
        felt = deque(chunk.rows[names.EXTERNAL_TORQUE]["effort"]) if names.EXTERNAL_TORQUE in chunk.rows else deque()
        samples = deque(chunk.rows[names.SAMPLES]["data"]) if names.SAMPLES in chunk.rows else deque()
        events = events_of_ticks(chunk)
        references, grippers = chunk.rows[names.REFERENCE], chunk.rows[names.GRIPPERS]["data"][:, self._wanted]
        for numbers, state, reference, wanted in zip(
            chunk.rows[names.TICK]["data"], states, references, grippers, strict=True
        ):
            tick = dict(zip(self._labels, numbers.tolist(), strict=True))
            openings = {arm: tick[f"opening_{arm}"] for arm in self._arms}
            yield RecordedTick(
                number=int(tick["index"]),
                now=tick["now"],
                dt=tick["dt"],
                following=bool(tick["following"]),
                connected=bool(tick["connected"]),
                samples=[_sample(samples.popleft()) for _ in range(int(tick["samples"]))],
                state=RobotState(
                    q=state["position"].copy(),
                    v=state["velocity"].copy(),
                    tau=state["effort"].copy(),
                    tau_external=felt.popleft().copy() if tick["external"] else None,
                    stamp=tick["state_stamp"],
                ),
                openings={arm: opening for arm, opening in openings.items() if opening != NOT_MEASURED},
                unsolved=int(tick["unsolved"]),
                events=events.get(int(tick["index"]), []),
                reference_q=reference["positions"].copy(),
                reference_v=reference["velocities"].copy(),
                grippers=dict(zip(self._arms, wanted.tolist(), strict=True)),
            )


class NoMoreTicksError(Exception):
    """There are no more ticks: the run was killed, or some were lost."""


def _sample(numbers: Array) -> HandSample:
    values = dict(zip(names.SAMPLE_FIELDS, numbers.tolist(), strict=True))
    inputs = {name: values[name] for name in HandInputs.__slots__}
    for button in ("button_upper", "button_lower"):
        inputs[button] = bool(inputs[button])
    return HandSample(
        hand=SIDES[int(values["hand"])],
        position=numbers[4:7].copy(),
        quaternion=numbers[7:11].copy(),
        pose_stamp=values["pose_stamp"],
        inputs=HandInputs(**inputs),
        inputs_stamp=values["inputs_stamp"],
        fault=HAND_FAULTS[int(values["fault"])],
    )
