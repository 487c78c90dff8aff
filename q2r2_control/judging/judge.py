"""Judges recordings, and keeps verdicts beside them."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from q2r2_control.config.judge import JudgeSettings
from q2r2_control.errors import RecordingError
from q2r2_control.judging.episode import Episode, read_episode
from q2r2_control.judging.figures import EpisodeFigures, figures_of
from q2r2_control.judging.parts import parts_of
from q2r2_control.judging.verdict import Verdict, verdict_of
from q2r2_control.recording.reader import Recording
from q2r2_control.recording.ros_recording import open_recording

VERDICT_FILE = "verdict.json"
_FORMAT = 2


@dataclass(frozen=True)
class Judged:
    """One episode, its numbers, and what became of them."""

    episode: Episode
    figures: EpisodeFigures
    verdict: Verdict
    settings: JudgeSettings

    def as_json(self) -> dict[str, Any]:
        """Plain data; what is not finite is None."""
        reasons = [asdict(reason) for reason in self.verdict.reasons]
        data = {"verdict": self.verdict.word, "reasons": reasons, "figures": asdict(self.figures)}
        found: dict[str, Any] = _plain(data)
        return found


def judge(recording: Recording, settings: JudgeSettings | None = None) -> list[Judged]:
    """Judge the episodes of a recording by these thresholds, or by those of the cell that it was recorded with.

    Raises :class:`RecordingError` where that cell cannot be built.
    """
    return [judge_episode(episode, settings) for episode in parts_of(read_episode(recording))]


def judge_episode(episode: Episode, settings: JudgeSettings | None = None) -> Judged:
    """Judge one episode; see :func:`judge`."""
    settings = settings or episode.config.judge
    figures = figures_of(episode, settings.dropout)
    return Judged(episode, figures, verdict_of(figures, settings), settings)


def judge_all(files: Sequence[Path], settings: JudgeSettings | None = None) -> Iterator[Judged]:
    """Judge recordings one after the other.

    Raises :class:`RecordingError` for a file that is none, before the first is judged.
    """
    for recording in [open_recording(file) for file in files]:
        yield from judge(recording, settings)


def keep_verdicts(judged: Sequence[Judged]) -> Path:
    """Write the verdicts on a recording's episodes beside it, whole or not at all. Raises :class:`RecordingError`."""
    recording = judged[0].episode.recording
    target = recording.file.with_name(VERDICT_FILE)
    part = target.with_suffix(".part")
    thresholds = judged[0].settings.model_dump(mode="json")
    episodes = [one.as_json() for one in judged]
    data = {"format": _FORMAT, "recording": recording.file.name, "episodes": episodes, "thresholds": thresholds}
    try:
        part.write_text(json.dumps(data, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        os.replace(part, target)
    except OSError as error:
        raise RecordingError(f"{target}: {error.strerror}") from error
    return target


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
