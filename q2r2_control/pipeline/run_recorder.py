"""What a run leaves behind: every tick goes into the summary and, where there are any, to the listeners."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import pinocchio as pin

from q2r2_control.compliance.admittance import AdmittanceReport
from q2r2_control.compliance.impedance import ImpedanceReport
from q2r2_control.compliance.repulsion import WallReport
from q2r2_control.config.control import ControllerSettings
from q2r2_control.drives.base import DriveReport
from q2r2_control.events import Event
from q2r2_control.robot.robot import Robot
from q2r2_control.pipeline.loop_clock import LoopClock
from q2r2_control.summary.run_summary import RunStatistics, RunSummary
from q2r2_control.summary.tick import Tick
from q2r2_control.supervision.tick_pacer import TickPacer
from q2r2_control.types import ArmTarget, Command, HandSample, Reference, RobotState


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

    @property
    def listened(self) -> bool:
        """Whether anybody is to be told of ticks."""
        return bool(self._listeners)

    def add(
        self,
        dt: float,
        compute_time: float,
        reference: Reference,
        targets: dict[str, ArmTarget],
        tools: dict[str, pin.SE3],
        engaged: dict[str, bool],
        drive: DriveReport,
        events: Iterable[Event],
        held_grippers: Mapping[str, tuple[str, str]],
    ) -> None:
        """Count one tick: see the fields of :class:`Tick`; ``events`` are those of the arms' teleoperation in it."""
        statistics = self._statistics
        statistics.tick.add(compute_time)
        statistics.add(dt, reference, targets, tools, engaged)
        statistics.add_drive(dt, drive)
        statistics.add_held_grippers(dt, held_grippers)
        statistics.events.extend(events)

    def add_holding(self, dt: float, holding: Mapping[str, bool]) -> None:
        """See :meth:`RunStatistics.add_holding`."""
        self._statistics.add_holding(dt, holding)

    def tell(self, tick: Tick) -> None:
        """Give one tick to every listener."""
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
            clock.wall_time(), pacer.missed_ticks, pacer.stretched, clock.lateness.percentiles(), clock.overruns
        )
