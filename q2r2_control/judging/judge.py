"""Judges the episodes of recordings, and keeps verdicts beside them."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from q2r2_control.config.recording import JudgeSettings
from q2r2_control.errors import RecordingError
from q2r2_control.judging.episode import Episode, Hand, read_episode
from q2r2_control.judging.figures import EpisodeFigures, figures_of
from q2r2_control.judging.verdict import Verdict, verdict_of
from q2r2_control.recording.episode_spans import EpisodeSpan, spans_of
from q2r2_control.recording.reader import Recording
from q2r2_control.recording.ros_recording import open_recording

VERDICT_FILE = "verdict.json"
_FORMAT = 2


def parts_of(episode: Episode) -> list[Episode]:
    """The episodes of a recording in their order; where the operator told of none, the whole."""
    spans = spans_of(episode.events, episode.success)
    return [part_of(episode, span) if span.number else replace(episode, success=span.success) for span in spans]


def part_of(episode: Episode, span: EpisodeSpan) -> Episode:
    """An episode of a recording. Times are since it began, and its first tick is number 0."""
    ticks, frames = episode.ticks, episode.frames
    first, end = np.searchsorted(ticks.t, span.start), np.searchsorted(ticks.t, span.end, side="right")
    cut = {name: values[first:end] for name, values in vars(ticks).items()}
    began = float(cut["t"][0] - cut["dt"][0]) if len(cut["t"]) else 0.0
    if len(cut["t"]):
        cut |= {"t": cut["t"] - began, "number": cut["number"] - cut["number"][0]}
    shown = (first <= frames.at) & (frames.at < end)
    hands = {}
    for name, hand in episode.hands.items():
        inside = (span.start <= hand.polled) & (hand.polled <= span.end)
        received, polled = hand.received[inside] - began, hand.polled[inside] - began
        hands[name] = Hand(hand.arm, received, polled, hand.position[inside])
    told = span.end < math.inf
    return replace(
        episode,
        ticks=type(ticks)(**cut),
        frames=type(frames)(
            **{name: values[shown] for name, values in vars(frames).items()} | {"at": frames.at[shown] - first}
        ),
        tools=episode.tools[shown],
        hands=hands,
        events=[replace(event, t=event.t - began) for event in episode.events if span.start <= event.t <= span.end],
        damage=None if told else episode.damage,
        ended_by=None if told else episode.ended_by,
        success=span.success,
        part=span.number,
        discarded=span.discarded,
        ended_by_operator=told,
    )


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
        return dict(_plain({"verdict": self.verdict.word, "reasons": reasons, "figures": asdict(self.figures)}))


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
