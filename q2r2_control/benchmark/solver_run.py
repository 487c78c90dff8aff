"""Run the same motion with one QP solver after another, in one process. Compare its times and motions with DAQP's.

The motion is the contact motion of the bench. Both tools are sent to positions that they cannot reach. Therefore rows
and box of the QP are active at nearly every tick. All solvers get the same cell, targets and ticks, and no time limit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from q2r2_control.benchmark.motion_run import MotionFigures, MotionRun, OwnController, figures_of, play_motion
from q2r2_control.benchmark.work_motions import TIMED_MOTIONS, WorkMotion
from q2r2_control.config.cell import Config
from q2r2_control.control.solvers.registry import DAQP, check_installed
from q2r2_control.errors import ConfigError
from q2r2_control.robot.robot import Robot

SOLVERS = (DAQP, "osqp", "quadprog", "proxqp", "piqp", "clarabel", "scs", "highs")
CONTACT = TIMED_MOTIONS[1]
DT = 0.002  # Duration of a tick [s].
INSTALL = "pip install 'qpsolvers[open-source-solvers]'"
_PATIENCE = 3.0  # Longest computing time of a solver's run, as a multiple of the motion's duration.


@dataclass(frozen=True, slots=True)
class SolverFigures:
    """The figures of one solver in the motion."""

    solver: str
    unsolved_percent: float  # Percentage of ticks with an unsolved QP.
    # Largest distance, in any tick, between a tool's positions with this solver and with DAQP; None without ticks.
    off_daqp_mm: float | None
    motion: MotionFigures


@dataclass(frozen=True, slots=True)
class SolverReport:
    """The figures of all solvers in one motion."""

    cell: str
    motion: str
    dt: float  # Duration of a tick [s].
    figures: list[SolverFigures]  # The figures of DAQP come first.
    missing: list[str]  # Names of solvers that are not installed.


def run_solvers(
    config: Config,
    names: Sequence[str] = SOLVERS,
    progress: Callable[[str], None] = lambda what: None,
    motion: WorkMotion = CONTACT,
) -> SolverReport:
    """Run ``motion`` with DAQP, and with each solver in ``names`` that is installed.

    Args:
        config: The cell for which ``motion`` is made, such as ``config/dual_iiwa7.yaml``.
        names: The names of solvers.
        progress: Called with a text before each run.
        motion: The motion to run.
    """
    robot = Robot.from_config(config)
    figures: list[SolverFigures] = []
    missing: list[str] = []
    daqp: MotionRun | None = None
    for name in dict.fromkeys((DAQP, *names)):
        try:
            check_installed(name)
        except ConfigError:
            missing.append(name)
            continue
        progress(f"{motion.name} with {name}")
        controller = OwnController(robot, _with_solver(config, name), name)
        run = play_motion(controller, robot, motion, _PATIENCE, DT)
        daqp = daqp or run
        figures.append(
            SolverFigures(
                solver=name,
                unsolved_percent=100.0 * float(np.mean(controller.unsolved)) if controller.unsolved else 0.0,
                off_daqp_mm=_apart_mm(run, daqp, robot),
                motion=figures_of(run, controller, robot, motion, DT),
            )
        )
    return SolverReport(config.name, motion.name, DT, figures, missing)


def _with_solver(config: Config, name: str) -> Config:
    return config.model_copy(update={"control": config.control.with_solver(name)})


def _apart_mm(run: MotionRun, other: MotionRun, robot: Robot) -> float | None:
    """Return the largest distance, in any tick, between a tool's positions in the two runs [mm]; None without ticks."""
    ticks = min(len(run.q), len(other.q))
    if not ticks:
        return None
    tools = [
        [[robot.tool_pose(q, arm).translation for arm in robot.arms] for q in one.q[:ticks]] for one in (run, other)
    ]
    return 1e3 * float(np.linalg.norm(np.array(tools[0]) - np.array(tools[1]), axis=-1).max())
