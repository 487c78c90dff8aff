"""The episodes that an operator told of within one recording, each as if it had been recorded alone."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from q2r2_control.judging.episode import Episode, Hand
from q2r2_control.recording.episode_spans import EpisodeSpan, spans_of


def parts_of(episode: Episode) -> list[Episode]:
    """The episodes of a recording in their order; where the operator told of none, the whole."""
    spans = spans_of(episode.events, episode.success)
    if len(spans) == 1 and spans[0].whole:
        return [replace(episode, success=spans[0].success)]
    return [part_of(episode, span, number) for number, span in enumerate(spans, 1)]


def part_of(episode: Episode, span: EpisodeSpan, number: int) -> Episode:
    """The ``number``-th episode of a recording. Times are since it began, and its first tick is number 0."""
    ticks, frames = episode.ticks, episode.frames
    first, end = np.searchsorted(ticks.t, span.start), np.searchsorted(ticks.t, span.end, side="right")
    inside = slice(first, end)
    cut = {name: values[inside] for name, values in vars(ticks).items()}
    began = float(cut["t"][0] - cut["dt"][0]) if len(cut["t"]) else 0.0
    if len(cut["t"]):
        cut |= {"t": cut["t"] - began, "number": cut["number"] - cut["number"][0]}
    shown = (first <= frames.at) & (frames.at < end)
    told = span.end < math.inf
    return replace(
        episode,
        ticks=type(ticks)(**cut),
        frames=type(frames)(
            **{name: values[shown] for name, values in vars(frames).items()} | {"at": frames.at[shown] - first}
        ),
        tools=episode.tools[shown],
        hands={name: _hand(hand, span, began) for name, hand in episode.hands.items()},
        events=[replace(event, t=event.t - began) for event in episode.events if span.start <= event.t <= span.end],
        damage=None if told else episode.damage,
        ended_by=None if told else episode.ended_by,
        success=span.success,
        part=number,
        discarded=span.discarded,
        ended_by_operator=told,
    )


def _hand(hand: Hand, span: EpisodeSpan, began: float) -> Hand:
    inside = (span.start <= hand.polled) & (hand.polled <= span.end)
    received, polled = hand.received[inside] - began, hand.polled[inside] - began
    return Hand(hand.arm, received, polled, hand.position[inside])
