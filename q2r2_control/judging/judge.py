"""Judge the episodes of recordings, and write the verdicts into a file beside each recording."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from q2r2_control.config.recording import JudgeSettings
from q2r2_control.errors import Q2R2Error, RecordingError
from q2r2_control.judging.contradictions import contradictions
from q2r2_control.judging.episode import Episode, Hand, read_episode
from q2r2_control.judging.figures import EpisodeFigures, figures_of
from q2r2_control.judging.thresholds import THRESHOLDS, Rejection
from q2r2_control.process.helper_process import reason_of
from q2r2_control.recording.reader import BROKEN, NO_END, EpisodeSpan, Recording, spans_of
from q2r2_control.recording.ros_recording import open_recording

VERDICT_FILE = "verdict.json"
_FORMAT = 2
_OF_CAMERAS = {threshold.name for threshold in THRESHOLDS if threshold.of == "camera"}
_LONGEST_REASON = 300  # The longest reason why a file cannot be read [characters].


@dataclass(frozen=True, slots=True)
class Verdict:
    """The verdict on an episode: it is discarded for all of the ``reasons``, or kept if there are none."""

    reasons: tuple[Rejection, ...]

    @property
    def keep(self) -> bool:
        return not self.reasons

    @property
    def word(self) -> str:
        return "keep" if self.keep else "discard"

    @property
    def line(self) -> str:
        reasons = "; ".join(reason.text for reason in self.reasons)
        return f"{self.word}: {reasons}" if reasons else self.word

    @property
    def findings(self) -> tuple[str, ...]:
        """The texts of the reasons. Cameras with the same reason share a text, which comes after all other texts."""
        others = list[str]()
        cameras: dict[str, list[str]] = {}
        for reason in self.reasons:
            if reason.name in _OF_CAMERAS:
                whose, _, finding = reason.text.partition(": ")
                cameras.setdefault(finding, []).append(whose.removeprefix("camera "))
            else:
                others.append(reason.text)
        joined = (f"camera{'s' * (len(names) > 1)} {', '.join(names)}: {what}" for what, names in cameras.items())
        return (*others, *joined)


def verdict_of(figures: EpisodeFigures, settings: JudgeSettings) -> Verdict:
    """Compare an episode's numbers with thresholds; a number that is None is not judged."""
    reasons = list(_unreadable(figures, settings))
    if not figures.engaged_s > 0.0:
        return Verdict((*reasons, Rejection("never_engaged", "no arm was ever engaged")))
    groups: dict[str, dict[str, Any]] = {
        "hand": {f"{name} hand: ": hand for name, hand in figures.hands.items()},
        "arm": {f"{name} arm: ": arm for name, arm in figures.arms.items()},
        "measured": {f"{name} arm: ": arm for name, arm in figures.measured.items()},
        "camera": {f"camera {name}: ": camera for name, camera in figures.cameras.items()},
        "subtask": {f"subtask {number}, {one.name}: ": one for number, one in enumerate(figures.subtasks, 1)},
        "episode": {"": figures},
        "timing": {"": figures.timing},
    }
    told = set[str]()
    for threshold in THRESHOLDS:
        limit = getattr(settings, threshold.name)
        for whose, found in groups[threshold.of].items():
            # The first reason about a camera also states the number of its missing pictures. Later reasons do not.
            missing = 0 if whose in told else getattr(found, "missing_pictures", 0)
            says = f"{whose}{missing} pictures missing, " if missing else whose
            if (reason := threshold.reason(getattr(found, threshold.figure), limit, says)) is not None:
                reasons.append(reason)
                told.add(whose)
    if settings.max_faults is not None and len(figures.faults) > settings.max_faults:
        first = figures.faults[0]
        also = f", and {len(figures.faults) - 1} more" if len(figures.faults) > 1 else ""
        what = f"fault: {first.arm} arm at {first.t:.2f} s: {first.reason}{also} (at most {settings.max_faults})"
        reasons.append(Rejection("max_faults", what))
    return Verdict((*reasons, *contradictions(figures, settings)))


def _unreadable(figures: EpisodeFigures, settings: JudgeSettings) -> Iterator[Rejection]:
    if figures.discarded:
        yield Rejection("operator", "its operator discarded it")
    if figures.success is False and not settings.keep_failed:
        yield Rejection("keep_failed", "it failed, as its operator or task says")
    if figures.missing_subtasks and settings.needs_subtasks:
        yield Rejection("needs_subtasks", f"it has no {', '.join(figures.missing_subtasks)}")
    if figures.ended_by is not None:
        yield Rejection("ended_by", f"a fault ended the run: {figures.ended_by}")
    if figures.damage is not None:
        yield Rejection("damaged", f"after {figures.duration_s:.2f} s {figures.damage}")
        return
    if not figures.timing.ticks:
        yield Rejection("no_ticks", "no tick of a controller was recorded")
    if settings.needs_end and not figures.timing.ended:
        yield Rejection("needs_end", NO_END)


def parts_of(episode: Episode) -> list[Episode]:
    """Return the episodes of a recording in their order, or the whole recording if the operator marked none."""
    spans = spans_of(episode.events, episode.success)
    if not spans[0].number:
        return [replace(episode, success=spans[0].success, subtask_starts=spans[0].subtask_starts)]
    return [part_of(episode, span) for span in spans]


def part_of(episode: Episode, span: EpisodeSpan) -> Episode:
    """Return an episode of a recording. Times are measured from its beginning, and its first tick has number 0."""
    ticks, frames = episode.ticks, episode.frames
    # ``searchsorted`` cannot be used: if the clock was set back, the times are not in ascending order.
    inside = np.flatnonzero((span.start <= ticks.t) & (ticks.t <= span.end))
    first, end = (int(inside[0]), int(inside[-1]) + 1) if len(inside) else (0, 0)
    cut = {name: values[first:end] for name, values in vars(ticks).items()}
    began = float(cut["t"][0] - cut["dt"][0]) if len(cut["t"]) else 0.0
    if len(cut["t"]):
        cut |= {"t": cut["t"] - began, "number": cut["number"] - cut["number"][0]}
    shown = (first <= frames.at) & (frames.at < end)
    hands = {}
    for name, hand in episode.hands.items():
        meant = (span.start <= hand.polled) & (hand.polled <= span.end)
        received, polled = hand.received[meant] - began, hand.polled[meant] - began
        hands[name] = Hand(hand.arm, received, polled, hand.position[meant])
    pictures = {name: found.between(span.start, span.end, began) for name, found in episode.pictures.items()}
    told = span.end < math.inf
    return replace(
        episode,
        ticks=type(ticks)(**cut),
        frames=type(frames)(
            **{name: values[shown] for name, values in vars(frames).items()} | {"at": frames.at[shown] - first}
        ),
        tools=episode.tools[shown],
        hands=hands,
        pictures=pictures,
        events=[replace(event, t=event.t - began) for event in episode.events if span.start <= event.t <= span.end],
        damage=None if told else episode.damage,
        ended_by=None if told else episode.ended_by,
        success=span.success,
        part=span.number,
        discarded=span.discarded,
        ended_by_operator=told,
        subtask_starts=tuple(start - began for start in span.subtask_starts),
    )


@dataclass(frozen=True)
class Judgement:
    """The verdict on an episode, and the numbers from which it follows. It can be sent to another machine."""

    figures: EpisodeFigures
    verdict: Verdict

    def as_json(self) -> dict[str, Any]:
        """Return plain data; numbers that are not finite become None."""
        reasons = [asdict(reason) for reason in self.verdict.reasons]
        data = {"verdict": self.verdict.word, "reasons": reasons, "figures": asdict(self.figures)}
        return dict(json.loads(json.dumps(data), parse_constant=lambda name: None))


@dataclass(frozen=True)
class Judged(Judgement):
    """A judgement with the episode itself, which plots show, and with the thresholds of the verdict."""

    episode: Episode
    settings: JudgeSettings


@dataclass(frozen=True)
class Unreadable:
    """A file that cannot be read, so it is discarded."""

    file: Path
    why: str  # The reason in one line, without the name of the file.

    @property
    def line(self) -> str:
        return f"discard: unreadable, {self.why}"

    def as_json(self) -> dict[str, Any]:
        reason = asdict(Rejection("unreadable", f"unreadable, {self.why}"))
        return {"verdict": "discard", "reasons": [reason], "file": str(self.file), "figures": None}


def judge(recording: Recording, settings: JudgeSettings | None = None, *, pictures: bool = True) -> list[Judged]:
    """Judge a recording's episodes by ``settings``; if it is None, by the thresholds of the recorded cell.

    Raises the same errors as :func:`read_episode`.
    """
    return [judge_episode(episode, settings) for episode in parts_of(read_episode(recording, pictures=pictures))]


def judge_episode(episode: Episode, settings: JudgeSettings | None = None) -> Judged:
    """Judge one episode; see :func:`judge`."""
    settings = settings or episode.config.judge
    figures = figures_of(episode, settings.dropout)
    return Judged(figures, verdict_of(figures, settings), episode, settings)


def judge_all(files: Sequence[Path], settings: JudgeSettings | None = None) -> Iterator[Judged | Unreadable]:
    """Judge recordings, one after the other, as ``q2r2 judge`` does.

    Args:
        files: The files of recordings, as ``recordings_in`` returns them.
        settings: The thresholds; None for the thresholds of each recording's own cell.

    Yields:
        The verdict on each episode, in the order of the files. A file that cannot be read gives an :class:`Unreadable`.
    """
    for file in files:
        try:
            yield from judge(open_recording(file), settings)
        except (Q2R2Error, *BROKEN) as error:
            yield Unreadable(file, reason_of(error).removeprefix(f"{file}: ")[:_LONGEST_REASON])


def judgements_of(settings: JudgeSettings | None, file: Path) -> list[Judgement | Unreadable]:
    """Judge one recording as :func:`judge_all` does, but return judgements without the episodes.

    Other processes and machines can run it, because its arguments and its result are small.
    """
    found = judge_all([file], settings)
    return [Judgement(one.figures, one.verdict) if isinstance(one, Judged) else one for one in found]


def discarded_episodes(file: Path, pictures: bool) -> dict[int, str]:
    """Return the number of each discarded episode of a recording, with the verdict in one line.

    The number 0 stands for the whole recording. The pictures are judged if ``pictures`` is True.

    Raises:
        RecordingError: If the recording cannot be opened or judged.
    """
    changed = open_recording(file).file.stat().st_mtime_ns
    return _discarded(file, pictures, file.absolute(), changed)


@lru_cache(maxsize=1)  # One result is enough, because the episodes of one file are requested one after the other.
def _discarded(file: Path, pictures: bool, absolute: Path, changed: int) -> dict[int, str]:
    """Return the result of :func:`discarded_episodes`.

    The function does not use ``absolute`` and ``changed``, the file's modification time. They belong to the key of the
    cache, because a worker process of a cluster lives long, and may see different files with the same name.
    """
    judged = judge(open_recording(file), pictures=pictures)
    return {one.figures.part or 0: one.verdict.line for one in judged if not one.verdict.keep}


def keep_verdicts(judged: Sequence[Judged]) -> Path:
    """Write the verdicts on a recording's episodes into a file beside the recording, and return the path of that file.

    The file is written completely or not at all.

    Raises:
        RecordingError: If the file cannot be written.
    """
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
