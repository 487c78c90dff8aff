"""Joins the messages of each tick, even if they are in two chunks of the file."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from q2r2_control.events import Event
from q2r2_control.recording.messages import SAMPLES, STATE, TEXT, TICK, Message, data_of, numbers_of
from q2r2_control.recording.recorded_reasons import event_of
from q2r2_control.recording.tick_rows import SAMPLE_FIELDS, Rows, tick_type
from q2r2_control.types import Array

# Ticks are decoded in groups with more ticks than this, since NumPy takes as long for one tick as for many.
_FEWEST = 200


@dataclass(frozen=True)
class TickChunk:
    """A group of n ticks that follow each other; n may be 0."""

    rows: Rows  # (n,) Rows with the dtype that tick_type returns.
    times: npt.NDArray[np.int64]  # (n,) The Unix times [ns].
    samples: Array  # (m, len(SAMPLE_FIELDS)) The m samples that the n ticks took.
    states: dict[int, str]  # The states of ticks as JSON. The keys are the ticks' numbers.

    @property
    def numbers(self) -> npt.NDArray[np.int64]:
        """Return the numbers (n,) of the ticks, from 0 on."""
        return np.asarray(self.rows["index"].astype(np.int64))

    def events(self) -> dict[int, list[Event]]:
        """Return the events of each tick, by the number of the tick.

        Raises ValueError, KeyError and TypeError if a state is not JSON or has other fields.
        """
        found = {number: json.loads(text).get("events", ()) for number, text in self.states.items()}
        return {number: [event_of(event) for event in events] for number, events in found.items()}


class TickAssembly:
    """Collects messages, and yields the ticks of which all messages have come.

    Messages have the numbers of their ticks and come in the order of time. Therefore a tick is complete when the next
    tick comes. The last tick is complete when there are no more messages.
    """

    topics = (TICK, SAMPLES, STATE)

    def __init__(self, arms: int, joints: int) -> None:
        self._type = tick_type(arms, joints)
        self._found: dict[str, list[Message]] = {topic: [] for topic in self.topics}
        self._last_number, self._last_time = -1, 0

    def add(self, messages: Iterable[tuple[str, Message]]) -> None:
        """Take messages with their topics, which are among :attr:`topics`."""
        found = self._found
        for topic, message in messages:
            found[topic].append(message)

    def whole(self) -> Iterator[TickChunk]:
        """Yield the complete ticks if there are more than 200. Raises the same errors as :meth:`rest`."""
        if len(self._found[TICK]) > _FEWEST:
            yield self._taken(self._found[TICK][-1].number)

    def rest(self, ended: bool) -> Iterator[TickChunk]:
        """Yield the ticks that are left. ``ended`` is True if the file was written to its end.

        If ``ended`` is False, and some samples of the last tick are missing, this tick is left out. Raises
        :class:`ValueError` if ticks are not in order, and the errors of rosbags if a message has another type.
        """
        if not any(self._found.values()):
            return
        chunk = self._taken(None)
        if len(chunk.rows) and not ended:
            last = int(chunk.numbers[-1])
            if np.count_nonzero(chunk.samples[:, 0] == last) < chunk.rows["samples"][-1]:
                kept = chunk.samples[chunk.samples[:, 0] < last]
                states = {number: text for number, text in chunk.states.items() if number < last}
                chunk = TickChunk(chunk.rows[:-1], chunk.times[:-1], kept, states)
        yield chunk

    def _taken(self, border: int | None) -> TickChunk:
        """Take out the messages of ticks whose numbers are below ``border``, and return these ticks.

        If ``border`` is None, the messages of all ticks are taken out.
        """
        taken: dict[str, list[Message]] = {}
        for topic, messages in self._found.items():
            end = len(messages)
            while border is not None and end and messages[end - 1].number >= border:
                end -= 1
            taken[topic], self._found[topic] = messages[:end], messages[end:]
        rows = numbers_of([message.payload for message in taken[TICK]], self._type.itemsize // 8)
        chunk = TickChunk(
            rows=rows.reshape(-1).view(self._type),
            times=np.array([message.time for message in taken[TICK]], dtype=np.int64),
            samples=numbers_of([message.payload for message in taken[SAMPLES]], len(SAMPLE_FIELDS)),
            states={message.number: str(data_of(message.payload, TEXT)) for message in taken[STATE]},
        )
        if (np.diff(chunk.numbers, prepend=self._last_number) < 1).any():
            raise ValueError("ticks are not in the order of their numbers")
        if (np.diff(chunk.times, prepend=self._last_time) < 0).any():
            raise ValueError("ticks are not in the order of time")
        if any(message.number <= self._last_number for message in taken[SAMPLES]):
            raise ValueError("samples come after the ticks that took them; mcap sort puts them in order")
        if len(rows):
            self._last_number, self._last_time = int(chunk.numbers[-1]), int(chunk.times[-1])
        return chunk
