"""Short episodes in simulated time: clean ones, and each spoiled in one way."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin

from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.inputs.played import HeadsetSampling, PlayedInput, SampleTiming
from q2r2_control.inputs.scripted import HANDS_AT_REST
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.recording.about import About
from q2r2_control.recording.recorder import Recorder
from q2r2_control.types import QUEST_CONTROLS, SIDES, HandInputs, HandSample
from tests.recording.runs import file_of, rewrite
from tests.support.processes import cell

RATE = 250.0  # [Hz], with longer substeps than by default, since most of a test's time goes by ticks
DURATION = 4.0  # [s]
PRESS, START = 0.2, 0.5  # [s]
_PRESSED = 0.1  # [s]
_BINDINGS = {"trigger": "toggle", "grip": "discard", "stick_up": "mark", "stick_down": "success"}
EPISODES = TeleopSettings.model_validate({"bindings": {name: f"record_{does}" for name, does in _BINDINGS.items()}})

Pose = Callable[[str, float], pin.SE3]


def at(hand: str, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> pin.SE3:
    """A hand that is displaced from where it began."""
    home = HANDS_AT_REST[hand]
    return pin.SE3(home.rotation, home.translation + np.array([x, y, z]))


def eased(t: float, begin: float = START, over: float = 1.0) -> float:
    """From 0 to 1 without a jerk."""
    s = min(max((t - begin) / over, 0.0), 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


class Work:
    """Reaches to and fro between points that are drawn at random, each hand its own; a stop at each."""

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
    """Engages; the gripper closes later."""
    return HandInputs(button_lower=PRESS <= t < PRESS + _PRESSED, button_upper=2.0 <= t < 2.0 + _PRESSED)


def operator(
    toggled: Sequence[float], discarded: float, marked: float | None = None, succeeded: float | None = None
) -> Callable[[str, float], HandInputs]:
    """Controls of an operator whose left hand tells of episodes at these times [s], by :data:`EPISODES`."""

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


def headset(hand: str, seed: int) -> SampleTiming:
    """Noise and uneven samples, some of them lost, and a hand that trembles."""
    return HeadsetSampling(hand, seed, tremor=True, dropout_probability=0.002)


class Thinned(SampleTiming):
    """Samples of a headset, without those at times that ``missing`` tells."""

    def __init__(self, inner: SampleTiming, missing: Callable[[float], bool]) -> None:
        self._inner, self._missing = inner, missing

    def times(self) -> Iterator[float]:
        return (t for t in self._inner.times() if not self._missing(t))

    def measured(self, pose: pin.SE3, t: float) -> pin.SE3:
        return self._inner.measured(pose, t)

    def lateness(self) -> float:
        return self._inner.lateness()


class Held:
    """An input whose samples the loop gets later than they were received."""

    controls = QUEST_CONTROLS

    def __init__(self, inner: PlayedInput, delay: float) -> None:
        self._inner, self._delay, self._waiting = inner, delay, list[HandSample]()

    @property
    def connected(self) -> bool:
        return self._inner.connected

    def start(self) -> None:
        self._inner.start()

    def poll(self, now: float) -> list[HandSample]:
        self._waiting += self._inner.poll(now)
        due = [sample for sample in self._waiting if sample.pose_stamp + self._delay <= now]
        self._waiting = self._waiting[len(due) :]
        return due

    def send_haptic(self, feedback: object) -> None:
        pass

    def close(self) -> None:
        self._inner.close()


def hands(
    seed: int = 0,
    pose: Pose | None = None,
    inputs: Callable[[str, float], HandInputs] = press,
    sampling: Callable[[str, int], SampleTiming] = headset,
) -> PlayedInput:
    """Hands that do random work unless a ``pose`` is given."""
    return PlayedInput(pose or Work(seed), inputs, {hand: sampling(hand, seed) for hand in SIDES})


def loop_of(source: object, **changes: object) -> Pipeline:
    """A pipeline at :data:`RATE` with a kinematic plant."""
    config = cell()
    control = config.control.model_copy(update={"max_substep": 1.0 / RATE})
    config = config.model_copy(update={"loop_rate_hz": RATE, "control": control, **changes})
    return Pipeline.from_config(config, input=source, plant="kinematic")  # type: ignore[arg-type]


def record_episode(folder: Path, source: object, duration: float = DURATION, **changes: object) -> Path:
    """The file of a recorded run."""
    loop = loop_of(source, **changes)
    with Recorder(folder, "test", waits=True) as recorder:
        recorder.begin(About.of(loop, False, {"task": "a test"}), loop.robot)
        loop.listeners.append(recorder)
        loop.run(duration, realtime=False)
    return file_of(recorder.summary)


def without_ticks(file: Path, target: Path, first: int, count: int) -> Path:
    """A copy without the messages of some ticks."""
    return rewrite(file, target, lambda _, message: None if first <= message.number < first + count else message)


def killed(file: Path, target: Path, ticks: int) -> Path:
    """What is left of a recording whose process was killed after some ticks: no index."""
    return rewrite(file, target, lambda _, message: message if message.number < ticks else None, whole=False)
