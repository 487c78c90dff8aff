"""Episodes for tests.

:func:`episode` makes an episode without a recording, so that a test can choose every number. :func:`record_episode`
records a run in which hands move the arms.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pinocchio as pin

from q2r2_control.config.cell import Config
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.events import Event
from q2r2_control.inputs.played import HeadsetSampling, PlayedInput
from q2r2_control.inputs.scripted import HANDS_AT_REST
from q2r2_control.judging.episode import Episode, Frames, Hand, Ticks
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.recording.about import LOOP
from q2r2_control.recording.reader import Recording
from q2r2_control.types import SIDES, Array, Flags, HandInputs, HandSample
from tests.recording.runs import file_of, record, rewrite
from tests.support.processes import cell, cell_robot, pipeline_of

DT = 0.002  # Period of the loop [s].
EVERY = 5  # Number of ticks per frame.
ARMS = ("left", "right")


def episode(
    seconds: float = 4.0,
    *,
    engaged: Flags | None = None,
    path: Array | None = None,
    target_path: Array | None = None,
    received: Sequence[float] | Array | None = None,
    hand_path: Array | None = None,
    delay: float = 0.0,
    events: Sequence[Event] = (),
    config: Config | None = None,
    **ticks: Any,
) -> Episode:
    """Return an episode. By default, both arms are engaged at rest, and each hand has a pose every 10 ms.

    ``path`` (m, 3) has the tool positions at the frames [m]. ``hand_path`` (k, 3) has the positions of both hands [m]
    at the times ``received`` (k,) [s]. A tick takes each of these positions ``delay`` [s] later. ``ticks`` replaces
    columns of :class:`Ticks`.
    """
    count = round(seconds / DT)
    t: Array = DT * np.arange(1, count + 1, dtype=np.float64)
    flags = np.zeros((count, 2), dtype=bool)
    rows = Ticks(
        number=np.arange(count),
        t=t,
        dt=np.full(count, DT),
        compute_time=np.full(count, 1e-4),
        following=np.arange(count) < count - 1,
        certified=np.ones(count, dtype=bool),
        fallback=np.zeros(count, dtype=bool),
        distance=np.full(count, 0.1),
        margin=np.full(count, 0.08),
        engaged=np.ones((count, 2), dtype=bool) if engaged is None else np.stack((engaged, engaged), axis=1),
        by_policy=flags,
        rejected=flags,
        slip=np.zeros((count, 2)),
        slip_angle=np.zeros((count, 2)),
        gripper=np.ones((count, 2)),
        now=t,
        unmeasured=flags,
        joint_speed=np.zeros((count, 2)),
    )
    frames = np.arange(0, count, EVERY)
    poses = np.tile((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), (len(frames), 2, 1))
    tools, targets = poses.copy(), poses.copy()
    if path is not None:
        tools[:, :, :3] = path[:, None]
        targets[:, :, :3] = (path if target_path is None else target_path)[:, None]
    stamps = np.arange(0.0, seconds, 0.01) if received is None else np.asarray(received)
    places = np.zeros((len(stamps), 3)) if hand_path is None else hand_path
    hands = {arm: Hand(arm, stamps, stamps + delay, places) for arm in ARMS}
    about = SimpleNamespace(arms=ARMS, realtime=True, notes={"task": "to <move>"}, source=LOOP)
    recording = SimpleNamespace(about=about, closed=True, file=Path("some/where/run.mcap"), counts=None)
    joints, openings = np.zeros((len(frames), 14)), np.ones((len(frames), 2))
    return Episode(
        recording=cast(Recording, recording),
        config=(config or cell()).model_copy(update={"loop_rate_hz": 1.0 / DT}),
        ticks=replace(rows, **ticks),
        robot=cell_robot(),
        frames=Frames(frames, joints, targets, tools.copy(), joints, joints, openings, openings),
        tools=tools,
        hands=hands,
        events=list(events),
        damage=None,
    )


def frame_times(seconds: float = 4.0) -> Array:
    return np.asarray(DT * np.arange(1, round(seconds / DT) + 1)[::EVERY])


# Rate of ticks [Hz]. It is low, and substeps are longer than by default, because ticks take most of a test's time.
RATE = 250.0
DURATION = 4.0  # Duration of a recorded episode [s].
PRESS, START = 0.2, 0.5  # Times at which the press and the motion of the hands begin [s].
_PRESSED = 0.1  # Duration of a press [s].
_BINDINGS = {"trigger": "toggle", "grip": "discard", "stick_up": "mark", "stick_down": "success"}
EPISODES = TeleopSettings.model_validate({"bindings": {name: f"record_{does}" for name, does in _BINDINGS.items()}})

Pose = Callable[[str, float], pin.SE3]


def at(hand: str, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> pin.SE3:
    home = HANDS_AT_REST[hand]
    return pin.SE3(home.rotation, home.translation + np.array([x, y, z]))


def eased(t: float, begin: float = START, over: float = 1.0) -> float:
    s = min(max((t - begin) / over, 0.0), 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


class Work:
    """Hands that reach from one random point to the next, and stop at each point. Each hand has points of its own."""

    def __init__(self, seed: int, begin: float = START, reaches: int = 20) -> None:
        random = np.random.default_rng(seed)
        self._ways: dict[str, list[tuple[float, float, np.ndarray]]] = {}
        for hand in SIDES:
            t, ways = begin, []
            for _ in range(reaches):
                over = float(random.uniform(0.8, 1.3))
                ways.append((t, over, random.uniform((-0.04, -0.07, 0.0), (0.08, 0.07, 0.12))))
                t += over + float(random.uniform(0.0, 0.3))
            self._ways[hand] = ways

    def __call__(self, hand: str, t: float) -> pin.SE3:
        place = np.zeros(3)
        for begin, over, goal in self._ways[hand]:
            if t < begin:
                break
            place = place + eased(t, begin, over) * (goal - place)
        return at(hand, *place)


def press(hand: str, t: float) -> HandInputs:
    return HandInputs(button_lower=PRESS <= t < PRESS + _PRESSED, button_upper=2.0 <= t < 2.0 + _PRESSED)


def operator(
    toggled: Sequence[float], discarded: float, marked: float | None = None, succeeded: float | None = None
) -> Callable[[str, float], HandInputs]:
    """Return the controls of an operator whose left hand begins, ends and rates episodes at these times [s].

    The bindings are :data:`EPISODES`. At each time in ``toggled``, an episode begins or ends.
    """

    def held(hand: str, t: float, *begin: float | None) -> float:
        return float(hand == "left" and any(at <= t < at + _PRESSED for at in begin if at is not None))

    def controls(hand: str, t: float) -> HandInputs:
        return replace(
            press(hand, t),
            press_index=held(hand, t, *toggled),
            press_middle=held(hand, t, discarded),
            thumb_stick_vertical=held(hand, t, marked) - held(hand, t, succeeded),
        )

    return controls


class WithDropouts(HeadsetSampling):
    def times(self) -> Iterator[float]:
        return (t for t in super().times() if not (t > 0.6 and t % 0.4 < 0.08))


class Late(PlayedInput):
    """An input whose samples reach the loop 80 ms after they were received."""

    _waiting: Sequence[HandSample] = ()

    def poll(self, now: float) -> list[HandSample]:
        waiting = [*self._waiting, *super().poll(now)]
        due = [sample for sample in waiting if sample.pose_stamp + 0.08 <= now]
        self._waiting = waiting[len(due) :]
        return due


def hands(
    seed: int = 0,
    pose: Pose | None = None,
    inputs: Callable[[str, float], HandInputs] = press,
    sampling: type[HeadsetSampling] = HeadsetSampling,
    played: type[PlayedInput] = PlayedInput,
) -> PlayedInput:
    """Return hands of a headset that do random work unless a ``pose`` is given.

    Samples come at uneven times and have noise, and some of them are lost. The hands tremble.
    """
    timing = {hand: sampling(hand, seed, tremor=True, dropout_probability=0.002) for hand in SIDES}
    return played(pose or Work(seed), inputs, timing)


def loop_of(source: PlayedInput, **changes: object) -> Pipeline:
    """Return a pipeline at :data:`RATE` with a kinematic plant."""
    control = cell().control.model_copy(update={"max_substep": 1.0 / RATE})
    changes = {"loop_rate_hz": RATE, "control": control, "cameras": {}, **changes}
    return pipeline_of(changes, source, "kinematic", "position")


def record_episode(folder: Path, source: PlayedInput, duration: float = DURATION, **changes: object) -> Path:
    return file_of(record(folder, loop_of(source, **changes), duration))


def without_ticks(file: Path, target: Path, first: int, count: int) -> Path:
    return rewrite(file, target, lambda _, message: None if first <= message.number < first + count else message)


def killed(file: Path, target: Path, ticks: int) -> Path:
    return rewrite(file, target, lambda _, message: message if message.number < ticks else None, whole=False)
