"""Every tick goes into the summary and to the listeners."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from q2r2_control.config.control import ControllerSettings
from q2r2_control.pipeline.loop_clock import LoopClock
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.run_summary import RunStatistics, RunSummary
from q2r2_control.summary.tick import Tick
from q2r2_control.supervision.tick_pacer import TickPacer
from q2r2_control.types import HandSample


class RunRecorder:
    """Adds up every tick and tells listeners of it. A listener that raises ends the run and is not called again."""

    def __init__(
        self,
        robot: Robot,
        control: ControllerSettings,
        listeners: Iterable[Callable[[Tick], None]],
        stop: Callable[[], None],
    ) -> None:
        self._statistics = RunStatistics(robot, control)
        self._listeners, self._stop = list(listeners), stop
        self._failure: Exception | None = None  # of a listener

    def add_latency(self, samples: list[HandSample], now: float) -> None:
        """See :meth:`RunStatistics.add_latency`."""
        self._statistics.add_latency(samples, now)

    @property
    def keeps_episodes(self) -> bool:
        """Whether a listener records the run to where episodes of it can be found."""
        return any(getattr(listener, "keeps_episodes", False) for listener in self._listeners)

    def add(self, tick: Tick) -> None:
        """Count one tick, and hand it to every listener."""
        self._statistics.add(tick)
        for listener in list(self._listeners):
            try:
                listener(tick)
            except Exception as error:
                self._listeners.remove(listener)
                self._failure = self._failure or error
                self._stop()

    def summary(self, clock: LoopClock, pacer: TickPacer) -> RunSummary:
        """The run so far. Raises the first exception of a listener."""
        if self._failure is not None:
            raise self._failure
        return self._statistics.summary(
            clock.wall_time(), pacer.missed_ticks, pacer.stretched, clock.lateness.percentiles(1e-6), clock.overruns
        )
