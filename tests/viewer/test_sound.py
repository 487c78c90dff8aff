"""What an operator hears of a run: by the terminal's bell, or by the system's player."""

from __future__ import annotations

import os
import wave
from pathlib import Path

import numpy as np
import pytest

from q2r2_control.errors import ConfigError
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.types import Event
from q2r2_control.viewer.sound import (
    ENGAGED,
    EPISODE_BEGINS,
    EPISODE_ENDS,
    FAULT,
    PLAYERS,
    Sound,
    SoundKind,
    sound_of,
    sounding,
)
from tests.support.hands_input import HandsInput
from tests.support.watch import cell

# Keeps each file that it is to play; a system's player takes the file's name as well.
PLAYER = '#!/bin/sh\nn=$(ls "$HEARD" | wc -l)\ncp "$1" "$HEARD/$n.wav"\n'


class VanishingHands(HandsInput):
    """Engages both arms, and sends nothing any more from a second on."""

    def poll(self, now: float) -> list:
        return super().poll(now) if now < 1.0 else []


def run(kind: SoundKind) -> None:
    config = cell().model_copy(update={"loop_rate_hz": 250.0})
    loop = Pipeline.from_config(config, input=VanishingHands(), plant="kinematic")
    with sounding(kind) as sounds:
        loop.listeners.append(sounds)
        loop.run(1.5, realtime=False)


@pytest.mark.parametrize(
    ("source", "destination", "reason", "sound"),
    [
        ("paused", "engaged", "lower button", ENGAGED),
        ("engaged", "lost", "no pose for 0.15 s", FAULT),
        ("paused", "paused", "not engaged: stopped", FAULT),
        ("engaged", "engaged", "episode begins", EPISODE_BEGINS),
        ("engaged", "engaged", "episode ends", EPISODE_ENDS),
        ("engaged", "engaged", "mark", None),
        ("engaged", "pausing", "lower button", None),
    ],
)
def test_what_an_operator_has_to_know_is_heard(source: str, destination: str, reason: str, sound: Sound | None) -> None:
    assert sound_of(Event(1.0, "left", source, destination, reason)) == sound


def test_the_bell_rings_for_what_happens_in_a_run(capsys: pytest.CaptureFixture[str]) -> None:
    run(SoundKind.BELL)
    rung = capsys.readouterr().err.count("\a")
    assert FAULT.bells <= rung <= ENGAGED.bells + FAULT.bells  # a fault is never lost, whatever came right before


def test_the_systems_player_gets_files_that_hold_the_tones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    heard, programs = tmp_path / "heard", tmp_path / "programs"
    heard.mkdir()
    programs.mkdir()
    player = programs / PLAYERS[0]
    player.write_text(PLAYER)
    player.chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("HEARD", str(heard))
    run(SoundKind.TONES)
    with wave.open(str(sorted(heard.glob("*.wav"))[-1]), "rb") as played:
        samples = np.frombuffer(played.readframes(played.getnframes()), dtype=np.int16)
        rate = played.getframerate()
    assert len(samples) / rate == pytest.approx(sum(duration for _, duration in FAULT.tones), abs=0.01)
    spectrum = np.abs(np.fft.rfft(samples))
    assert np.fft.rfftfreq(len(samples), 1.0 / rate)[spectrum.argmax()] == pytest.approx(FAULT.tones[0][0], abs=5.0)


def test_without_a_player_it_says_what_is_allowed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ConfigError, match=r"^--sound tones: no player of sounds; allowed: one of pw-play"):
        run(SoundKind.TONES)
