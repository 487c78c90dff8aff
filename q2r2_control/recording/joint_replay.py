"""The references of a recording sent to a plant, through the pipeline's own loop and the controller's promises."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

from q2r2_control.config.cell import Config
from q2r2_control.errors import PlantError
from q2r2_control.pipeline.loop_clock import LoopClock
from q2r2_control.pipeline.operator_side import OperatorSide
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.base import Plant, make_plant
from q2r2_control.recording.comparison import changes
from q2r2_control.recording.recorded_ticks import RecordedTicks
from q2r2_control.recording.recorded_way import RecordedWay
from q2r2_control.recording.replay import opened
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.run_summary import RunSummary
from q2r2_control.summary.tick import Tick
from q2r2_control.types import QUEST_CONTROLS, ArmTarget, HandSample, HapticFeedback
from q2r2_control.wording import limit_name

_FOLLOWED = 0.01  # how near a reference is followed that nothing holds back [rad]
_REASONS = 4  # that are told of one time


@dataclass(slots=True)
class HeldBack:
    """References one after the other that were not followed, or not as far as they go."""

    start_s: float  # in the recording
    end_s: float
    references: int
    farthest_rad: float  # between a joint's reference and the recorded one
    reasons: list[str]

    @property
    def line(self) -> str:
        """For people."""
        when = f"{self.start_s:.3f} .. {self.end_s:.3f} s: {self.references} references held back"
        return f"{when}, by {self.farthest_rad:.3g} rad at most: {'; '.join(self.reasons)}"


@dataclass(frozen=True, slots=True)
class JointReplay:
    """What became of the references."""

    references: int  # sent
    held_back: list[HeldBack]
    farthest_rad: float  # of a reference that was not held back
    ended_by: str | None  # why not all were sent
    summary: RunSummary | None  # None: the plant failed
    notes: list[str]  # what is not as it was when it was recorded

    @property
    def whole(self) -> bool:
        """Whether all references were sent and followed."""
        return not self.held_back and self.ended_by is None


def replay_joints(
    path: Path,
    plant: str,
    config: Config | None = None,
    prepare: Callable[[Pipeline], None] = lambda pipeline: None,
) -> JointReplay:
    """Let a plant go to the first reference of a recording, and then follow all of them.

    Every tick keeps the controller's contract for the cell, which is the recorded one or ``config``. ``prepare`` gets
    the pipeline before it runs. Raises as :func:`replay` does; what is damaged further on ends it.
    """
    recording, cell, robot = opened(path, config)
    ticks = RecordedTicks(recording)
    pipeline = JointReplayPipeline(cell, robot, ticks, make_plant(plant, robot, cell), recording.about.mode)
    watch = _Watch(pipeline.way, ticks)
    pipeline.listeners.append(watch)
    prepare(pipeline)
    summary, ended_by = None, None
    try:
        summary = pipeline.run(realtime=False)
        ended_by = pipeline.way.fault
    except PlantError as error:
        ended_by = str(error)
    if ended_by is None and ticks.missing:
        ended_by = f"{ticks.missing} ticks were lost here when it was recorded"
    elif ended_by is None and ticks.next is not None:
        ended_by = "it was stopped"
    return JointReplay(
        ticks.count, watch.held_back, watch.farthest, ended_by, summary, changes(recording.about, cell, robot)
    )


class JointReplayPipeline(Pipeline):
    """The loop with a recording's references in place of an operator. Runs once."""

    def __init__(self, config: Config, robot: Robot, ticks: RecordedTicks, plant: Plant, mode: str) -> None:
        super().__init__(config, robot, _NoHands(), plant, mode)
        joints = tuple(robot.joint_names)
        self.way = RecordedWay(ticks, joints, robot.velocity_limit, lambda q: self.supervisor.homing.way_to(q))

    def make_clock(self, realtime: bool) -> LoopClock:
        """See :meth:`Pipeline.make_clock`: ticks take what the recorded ones took."""
        return _Clock(1.0 / self.config.loop_rate_hz, self.way)

    def make_operator(self) -> OperatorSide:
        """See :meth:`Pipeline.make_operator`: nobody asks for anything but grippers, the joints are led."""
        self.supervisor.lead(self.way)
        return _Lead(self)


class _Lead(OperatorSide):
    """Asks for the grippers only; where the joints go, supervision was told."""

    def __init__(self, pipeline: JointReplayPipeline) -> None:
        super().__init__(pipeline.teleop, pipeline.input, pipeline.supervisor, pipeline.controller, pipeline.requests)
        self._wanted = pipeline.way.grippers
        self._arms = tuple(pipeline.robot.arms)

    def targets(
        self,
        samples: list[HandSample],
        tools: Mapping[str, pin.SE3],
        now: float,
    ) -> dict[str, ArmTarget]:
        """See :meth:`OperatorSide.targets`."""
        return {arm: ArmTarget(None, self._wanted.get(arm, 1.0)) for arm in self._arms}


class _Clock(LoopClock):
    """Ticks as long as those of the recording, and of one period where there are none."""

    def __init__(self, period: float, way: RecordedWay) -> None:
        super().__init__(period, realtime=False)
        self._nominal, self._way = period, way

    def wait(self) -> float:
        """See :meth:`LoopClock.wait`."""
        dt = self._way.advance(self._nominal)
        self.now += dt
        return dt

    def after(self, duration: float) -> bool:
        """Whether all references were sent."""
        return self._way.ended


class _NoHands:
    """Nobody. Implements :class:`Input`."""

    controls = QUEST_CONTROLS

    connected = False

    def start(self) -> None:
        pass

    def poll(self, now: float) -> list[HandSample]:
        return []

    def send_haptic(self, feedback: HapticFeedback) -> None:
        pass

    def close(self) -> None:
        pass


class _Watch:
    """A listener that notes which references were held back, and why."""

    def __init__(self, way: RecordedWay, ticks: RecordedTicks) -> None:
        self._way, self._start = way, ticks.start.now
        self._number = 0
        self._last = -1  # number of the last one that was held back
        self.held_back: list[HeldBack] = []
        self.farthest = 0.0

    def __call__(self, tick: Tick) -> None:
        """Take one tick."""
        recorded = self._way.current
        if recorded is None:
            return
        self._number += 1
        off = np.abs(tick.reference.q - recorded.reference_q)
        away = float(off.max()) if np.isfinite(off).all() else 0.0
        if self._way.refused is None and away <= _FOLLOWED:
            self.farthest = max(self.farthest, away)
            return
        reason = self._way.refused or ", ".join(map(limit_name, tick.reference.report.binding)) or "it catches up"
        at = recorded.now - self._start
        if self._last != self._number - 1:
            self.held_back.append(HeldBack(at, at, 0, 0.0, []))
        self._last = self._number
        held = self.held_back[-1]
        held.end_s, held.references = at, held.references + 1
        held.farthest_rad = max(held.farthest_rad, away)
        if reason not in held.reasons and len(held.reasons) < _REASONS:
            held.reasons.append(reason)
