"""Replay a recorded run on a page with a time line. The frames are kept in memory, and shown at the recorded speed."""

from __future__ import annotations

import time
from bisect import bisect_right
from dataclasses import replace
from threading import Event as Flag
from threading import Thread
from typing import Any

from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.process.scheduling import StopRequest, stop_on_signals
from q2r2_control.summary.tick import Tick
from q2r2_control.viewer.arm_words import Told, told_after
from q2r2_control.viewer.web.exchange import Frame, PagePlay, PageRequest, PageSeek
from q2r2_control.viewer.web.view import PageView

_KEPT = 0.05  # Time between two frames that are kept, in the run's time [s].
_PERIOD = 1.0 / 30.0  # Time between two frames that are shown while the replay plays [s].
_STILL = 0.25  # Time between two frames that are shown while the replay is paused [s].


class Playback:
    """A listener of a replay. The page plays the kept frames, from the position of its time line."""

    def __init__(self, view: PageView) -> None:
        self._view = view
        self._frames: list[Frame] = []
        self._times: list[float] = []  # Times of the frames [s].
        self._told: dict[str, Told] = {}  # For each arm, the events that say why it is in its state.
        self._ticks, self._slowest = 0, 0.0
        self._position, self._playing, self._complete = 0.0, True, False
        self._ended = Flag()

    def begin(self, pipeline: Pipeline, title: str) -> str:
        """Serve the page before the replay begins, and return its URL; raises :class:`ConfigError` if this fails."""
        url = self._view.serve(pipeline, title, replayed=True, on_request=self._on_request)
        pipeline.listeners.append(self)
        Thread(target=self._play, daemon=True).start()
        return url

    def __call__(self, tick: Tick) -> None:
        """Keep a frame with this tick, if a frame is due."""
        self._ticks += 1
        self._slowest = max(self._slowest, tick.compute_time)
        self._told = told_after(self._told, tick.events)
        if not self._times or tick.t >= self._times[-1] + _KEPT:
            binding = tuple(tick.reference.report.binding)
            events = tuple(event for told in self._told.values() for event in told.events)
            self._frames.append(Frame(tick, events, binding, self._ticks, self._slowest, None))
            self._times.append(tick.t)
            self._ticks, self._slowest = 0, 0.0

    def wait(self) -> None:
        """Wait until the page's button or Ctrl-C ends the replay, or the page's process has ended."""
        stop, self._complete = StopRequest(), True
        with stop_on_signals(stop.ask):
            while not (self._ended.wait(_PERIOD) or stop.asked or not self._view.alive):
                pass
        self._ended.set()

    def _on_request(self, request: Any) -> None:
        """Do what the page requests. The thread that receives the page's answers calls this."""
        if request is PageRequest.STOP:
            self._ended.set()
        elif isinstance(request, PagePlay):
            self._playing = not self._playing
            if self._playing and self._times and self._position >= self._times[-1]:
                self._position = 0.0
        elif isinstance(request, PageSeek):
            self._position = request.time

    def _play(self) -> None:
        then = time.monotonic()
        while not self._ended.wait(_PERIOD if self._playing else _STILL):
            passed, then = time.monotonic() - then, time.monotonic()
            if self._times:
                end = self._times[-1]
                self._position = min(max(self._position + passed * self._playing, 0.0), end)
                self._playing &= not (self._complete and self._position == end)
                frame = self._frames[max(bisect_right(self._times, self._position) - 1, 0)]
                self._view.send(replace(frame, end=end))
