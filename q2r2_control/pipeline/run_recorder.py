"""Collect the figures of one run, and call its listeners."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

from q2r2_control.config.control import ControllerSettings
from q2r2_control.pipeline.loop_clock import LoopClock
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.run_summary import RunStatistics, RunSummary
from q2r2_control.summary.tick import Tick
from q2r2_control.supervision.tick_pacer import TickPacer


class RunRecorder(RunStatistics):
    """Adds every tick to the statistics and passes it to the listeners.

    A listener that raises ends the run, and is not called again. If ``counts`` is False, ticks are not added to the
    statistics, because nobody can ask for the summary of that run.
    """

    def __init__(
        self,
        robot: Robot,
        control: ControllerSettings,
        listeners: Iterable[Callable[[Tick], None]],
        stop: Callable[[], None],
        counts: bool = True,
    ) -> None:
        super().__init__(robot, control)
        self._counts = counts
        self._listeners, self._stop = list(listeners), stop
        self._failure: Exception | None = None  # The first exception of a listener.

    @property
    def keeps_episodes(self) -> bool:
        """Whether a listener records the run into a file that can hold episodes."""
        return any(getattr(listener, "keeps_episodes", False) for listener in self._listeners)

    def add(self, tick: Tick) -> None:
        """Count one tick, and pass it to every listener."""
        if self._counts:
            super().add(tick)
        for listener in list(self._listeners):
            try:
                listener(tick)
            except Exception as error:
                self._listeners.remove(listener)
                self._failure = self._failure or error
                self._stop()

    def finish(self, clock: LoopClock, pacer: TickPacer) -> RunSummary:
        """Return the summary of the whole run; raises the first exception of a listener."""
        if self._failure is not None:
            raise self._failure
        return replace(
            self.summary(clock.wall_time()),
            real_time_factor=clock.real_time_factor(),
            lateness_us=clock.lateness.percentiles(1e-6),
            overruns=clock.overruns,
            missed_ticks=pacer.missed_ticks,
            stretched_s=pacer.stretched,
        )
