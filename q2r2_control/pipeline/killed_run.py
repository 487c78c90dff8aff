"""A run that is killed while hands move its arms. Another process, which still runs, has to stop the arms.

If a loop dies, the process that answers the cabinets brings the arms to rest on the certified stop. Then the answering
process ends and releases its ports. A commissioning checks this with a loop that runs in a process of its own.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from q2r2_control.config.cell import Config
from q2r2_control.errors import PlantError
from q2r2_control.pipeline.commissioning import LEAST_SPEED, LED, StopReport, stop_report, tool_speed
from q2r2_control.pipeline.slow_run import Moment, SlowRun
from q2r2_control.plants.fri.plant import FriPlant
from q2r2_control.process.helper_process import HelperProcess
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

_LOOKS = 0.005  # Time between two checks [s].
_PATIENCE = 5.0  # Longest time until the ports are released [s].
_FREEING = 0.5  # Time in which the system frees the memory of a killed program, before its end can be seen [s].


def main(requests: Iterator[Config], answer: Callable[[Any], None]) -> None:
    """Move all arms of each cell upwards, and pass every moment to ``answer``. This runs in the killed process."""
    for config in requests:
        with SlowRun(config, FriPlant, listener=answer) as run:
            run.let_go(list(run.robot.arms), 1.5 * LED)
        raise PlantError("the arms did not go up; begin where each tool has 100 mm of room above it")


def measure_kill(config: Config, posture: Callable[[], Array], led: float = LED) -> list[StopReport]:
    """Kill a run after its tools have moved up for ``led`` [s], and return the unchecked report of each arm's stop.

    ``posture`` is called when nothing commands the arms any more, and returns their posture at rest (nv,) [rad]. Raises
    :class:`PlantError` if the arms do not go up.
    """
    robot = Robot.from_config(config)
    plant = FriPlant(robot, config)
    moments: list[Moment] = []
    process = HelperProcess("leads the arms", __name__, moments.append)
    process.send(config)
    try:
        # The process is killed only while the tools move up fast enough. After a late tick, a tool may be too slow for
        # a measurement of its stop.
        while _led(moments) < led or not _goes_up(robot, moments[-1]):
            if not process.alive:
                raise PlantError(process.fault or "the arms did not follow the hands")
            time.sleep(_LOOKS)
    finally:
        killed = time.monotonic()
        process.kill()
    while not plant.is_released():
        if time.monotonic() - killed > _PATIENCE:
            raise PlantError(f"a run that was killed still holds the cabinets' ports after {_PATIENCE:g} s")
        time.sleep(_LOOKS)
    took = time.monotonic() - killed
    # Arms that waited for each other may have begun to brake just before the process was killed. The stop is therefore
    # measured from the last moment at which they moved up.
    last, rest = next(moment for moment in reversed(moments) if _goes_up(robot, moment)), posture()
    reports = [stop_report(robot, arm, "program killed", last, last.q, rest, took) for arm in robot.arms]
    return [replace(report, allowed_s=report.allowed_s + _FREEING) for report in reports]


def _goes_up(robot: Robot, moment: Moment) -> bool:
    """Return whether all tools are fast enough for a stop that can be measured."""
    return min(tool_speed(robot, arm, moment) for arm in robot.arms) >= LEAST_SPEED


def _led(moments: list[Moment]) -> float:
    """Return the time for which all arms have followed their hands [s]; 0 if an arm does not follow now."""
    if not moments or not all(moments[-1].engaged.values()):
        return 0.0
    begun = next((moment for moment in moments if all(moment.engaged.values())), moments[-1])
    return moments[-1].now - begun.now
