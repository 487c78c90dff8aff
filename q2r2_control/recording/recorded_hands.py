"""The hands of a recording as an input of any cell: ``q2r2 run --input recording --recording FILE``.

A replay repeats a run with its own times. This input gives the same samples to a new run instead, which may be in real
time, with other arms and with another plant. Hands move arms by relative motion, so the new arms start at their home.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import parse_config
from q2r2_control.device_words import QUEST_WORDS
from q2r2_control.errors import ConfigError, RecordingError
from q2r2_control.recording.about import ROS
from q2r2_control.recording.reader import Recording
from q2r2_control.recording.recorded_ticks import RecordedTicks
from q2r2_control.types import QUEST_CONTROLS, HandSample, HapticFeedback


class RecordedHands:
    """An input that plays the samples of a recording once. It begins with the first poll.

    After the last recorded tick, the input is not connected any more, so the arms pause.
    """

    options = ("recording", "fast", "say")
    simulated = True
    feels = False

    def __init__(self, file: Path, config: Config, say: Callable[[str], None] = lambda line: None) -> None:
        """Read the samples of a recording.

        Args:
            file: The recording, or a folder with one recording.
            config: The cell that the hands will move.
            say: Called with the line that says that the recording is over.

        Raises:
            RecordingError: If the file is no recording of a loop, is damaged, or has no samples.
            ConfigError: If the axes of its samples are not the axes of the cell.
        """
        recording = Recording(file)
        if recording.about.source == ROS:
            raise RecordingError(
                f"{recording.file}: recorded from ROS nodes, which keeps no samples of hands; allowed: a recording of "
                "q2r2 run"
            )
        axes = parse_config(recording.about.cell, f"{recording.file}: its cell").teleop.axes
        if axes != config.teleop.axes:
            raise ConfigError(f"teleop.axes = {list(config.teleop.axes)}: allowed with {recording.file}: {list(axes)}")
        # A recording does not say which extra buttons the device had. It is assumed to have all bound buttons.
        buttons = QUEST_CONTROLS.buttons + config.teleop.bindings.of_device
        words = replace(
            QUEST_WORDS, nobody="these are the hands of a recording", absent="nothing: the recording is over"
        )
        self.controls = replace(QUEST_CONTROLS, buttons=buttons, words=words)
        self._say = say
        # All times below count from the first recorded tick, or from the first poll [s].
        self._samples: list[tuple[float, list[HandSample]]] = []  # The time and the samples of each tick with samples.
        self._changes: list[tuple[float, bool]] = []  # Times [s] from which the hands are connected or not.
        ticks = RecordedTicks(recording)
        # The time of the first tick, or of the start if there is no tick, by the recorded clock [s].
        self._begins = ticks.next.now if ticks.next is not None else ticks.start.now
        while ticks.next is not None:
            tick = ticks.advance()
            self._ends = tick.now - self._begins
            if tick.samples:
                self._samples.append((self._ends, tick.samples))
            if not self._changes or self._changes[-1][1] != tick.connected:
                self._changes.append((self._ends, tick.connected))
        if not self._samples:
            raise RecordingError(f"{recording.file}: no samples of hands were recorded")
        self.start()

    @classmethod
    def from_config(
        cls,
        config: Config,
        recording: str | None = None,
        fast: bool = False,
        say: Callable[[str], None] = lambda line: None,
    ) -> RecordedHands:
        """Read the samples of ``recording``. The samples are the same at any pace, so ``fast`` has no effect."""
        if recording is None:
            raise ConfigError("--input recording needs --recording FILE")
        return cls(Path(recording), config, say)

    @property
    def connected(self) -> bool:
        return self._connected

    def start(self) -> None:
        """Play the recording from its start at the next poll."""
        self._began: float | None = None  # Time of the first poll; None before it [s].
        self._next = self._next_change = 0
        self._connected = False

    def poll(self, now: float) -> list[HandSample]:
        if self._began is None:
            self._began = now
        passed, later, found = now - self._began, self._began - self._begins, list[HandSample]()
        while self._next < len(self._samples) and self._samples[self._next][0] <= passed:
            found += [_moved(sample, later) for sample in self._samples[self._next][1]]
            self._next += 1
        while self._next_change < len(self._changes) and self._changes[self._next_change][0] <= passed:
            self._connected = self._changes[self._next_change][1]
            self._next_change += 1
        if self._connected and passed > self._ends:
            self._connected = False
            self._say("the recording is over, and the arms pause")
        return found

    def send_haptic(self, feedback: HapticFeedback) -> None:
        """Do nothing, because nobody holds a controller."""

    def close(self) -> None: ...


def _moved(sample: HandSample, later: float) -> HandSample:
    """Return the same sample with both of its times moved by ``later`` [s]."""
    return replace(sample, pose_stamp=sample.pose_stamp + later, inputs_stamp=sample.inputs_stamp + later)
