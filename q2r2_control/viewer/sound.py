"""Sounds of a run: an operator looks at the robot, not at the screen."""

from __future__ import annotations

import math
import shutil
import struct
import subprocess
import sys
import threading
import wave
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from queue import Empty, SimpleQueue
from tempfile import TemporaryDirectory
from typing import NamedTuple

from q2r2_control.errors import ConfigError
from q2r2_control.runtime.recorder import Tick
from q2r2_control.teleop.arm_states import ArmState, is_fault
from q2r2_control.teleop.episode_marks import BEGINS, DISCARDED, ENDS, FAILED, SUCCEEDED, is_kept
from q2r2_control.types import Event

PLAYERS = ("pw-play", "paplay", "aplay", "afplay")  # each plays a file that is its only argument
_RATE, _LOUDNESS, _FADE = 16000, 0.4, 0.01  # [Hz], of full scale, [s]


class SoundKind(StrEnum):
    """How sounds are made."""

    BELL = "bell"  # of the terminal
    TONES = "tones"  # by the system's player


class Sound(NamedTuple):
    """What tells one thing."""

    bells: int
    tones: tuple[tuple[float, float], ...]  # frequency [Hz], duration [s]


ENGAGED = Sound(1, ((660.0, 0.1), (880.0, 0.1)))
FAULT = Sound(3, ((220.0, 0.2), (0.0, 0.08), (220.0, 0.2), (0.0, 0.08), (220.0, 0.3)))
EPISODE_BEGINS = Sound(1, ((1320.0, 0.08), (0.0, 0.05), (1320.0, 0.08)))
EPISODE_ENDS = Sound(2, ((1320.0, 0.08), (0.0, 0.05), (880.0, 0.15)))
EPISODE_KEPT = Sound(1, ((880.0, 0.1), (0.0, 0.05), (1320.0, 0.25)))
EPISODE_REJECTED = Sound(3, ((440.0, 0.15), (0.0, 0.05), (330.0, 0.3)))
ALL = (ENGAGED, FAULT, EPISODE_BEGINS, EPISODE_ENDS, EPISODE_KEPT, EPISODE_REJECTED)


def sound_of(event: Event) -> Sound | None:
    """What an event of an arm sounds like; most are silent."""
    if is_fault(event):
        return FAULT
    if event.source != event.destination:
        return ENGAGED if event.destination == ArmState.ENGAGED else None
    if (kept := is_kept(event.reason)) is not None:
        return EPISODE_KEPT if kept else EPISODE_REJECTED
    ends = dict.fromkeys((ENDS, DISCARDED, SUCCEEDED, FAILED), EPISODE_ENDS)
    return {BEGINS: EPISODE_BEGINS, **ends}.get(event.reason)


class SoundListener:
    """A listener of a run. A tick only puts its sounds in a queue; a thread makes them."""

    def __init__(self, play: Callable[[Sound], None]) -> None:
        self._play = play
        self._queue: SimpleQueue[Sound | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="sounds", daemon=True)
        self._thread.start()

    def __call__(self, tick: Tick) -> None:
        """Take one tick."""
        for sound in dict.fromkeys(map(sound_of, tick.events)):
            if sound is not None:
                self._queue.put(sound)

    def close(self) -> None:
        """End when what was put in the queue before has been played."""
        self._queue.put(None)
        self._thread.join(timeout=2.0)

    def _work(self) -> None:
        while (sound := self._queue.get()) is not None:
            sound, ends = self._newest(sound)
            try:
                self._play(sound)
            except OSError:
                return  # the terminal or the player is gone; the arms move on
            if ends:
                return

    def _newest(self, sound: Sound) -> tuple[Sound, bool]:
        """Of what is waiting the loudest word, so that sounds never lag behind; and whether the end was among it."""
        while True:
            try:
                other = self._queue.get_nowait()
            except Empty:
                return sound, False
            if other is None:
                return sound, True
            sound = FAULT if FAULT in (sound, other) else other


@contextmanager
def sounding(kind: SoundKind) -> Iterator[SoundListener]:
    """A listener that makes sounds for as long as the context lasts.

    Raises :class:`ConfigError` where there is no player of tones.
    """
    with TemporaryDirectory(prefix="q2r2-sounds-") as folder:
        listener = SoundListener(_ring if kind is SoundKind.BELL else _player(Path(folder)))
        try:
            yield listener
        finally:
            listener.close()


def _ring(sound: Sound) -> None:
    sys.stderr.write("\a" * sound.bells)
    sys.stderr.flush()


def _player(folder: Path) -> Callable[[Sound], None]:
    player = next((found for name in PLAYERS if (found := shutil.which(name))), None)
    if player is None:
        raise ConfigError(f"--sound tones: no player of sounds; allowed: one of {', '.join(PLAYERS)}, or --sound bell")
    files = {sound: folder / f"{index}.wav" for index, sound in enumerate(ALL)}
    for sound, file in files.items():
        _write(sound, file)

    def play(sound: Sound) -> None:
        quiet = subprocess.DEVNULL
        subprocess.run([player, str(files[sound])], stdin=quiet, stdout=quiet, stderr=quiet, check=False)

    return play


def _write(sound: Sound, file: Path) -> None:
    """As 16-bit samples, faded in and out so that nothing clicks."""
    samples = [value for frequency, duration in sound.tones for value in _tone(frequency, duration)]
    with wave.open(str(file), "wb") as out:
        out.setnchannels(1)
        out.setsampwidth(2)
        out.setframerate(_RATE)
        out.writeframes(struct.pack(f"<{len(samples)}h", *samples))


def _tone(frequency: float, duration: float) -> Iterator[int]:
    count = round(duration * _RATE)
    for index in range(count):
        fade = min(1.0, index / (_FADE * _RATE), (count - 1 - index) / (_FADE * _RATE))
        yield round(32767 * _LOUDNESS * fade * math.sin(2.0 * math.pi * frequency * index / _RATE))
