"""Run the same motion with one QP solver after another, in one process, and compare times and motions with DAQP's.

The motion is the contact motion of the bench. Both tools are sent to places that they cannot reach, so that rows and
box bind at nearly every tick. Every solver gets the same cell, targets and ticks. No solver has a time limit.
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
DT = 0.002  # [s]
INSTALL = "pip install 'qpsolvers[open-source-solvers]'"
_PATIENCE = 3.0  # Longest time that a solver may take, as a multiple of the motion's own time.


@dataclass(frozen=True, slots=True)
class SolverFigures:
    """The figures of one solver in the motion."""

    solver: str
    unsolved_percent: float  # Share of ticks with an unsolved QP.
    off_daqp_mm: float | None  # Largest distance of a tool from its position with DAQP; None without any tick.
    motion: MotionFigures


@dataclass(frozen=True, slots=True)
class SolverReport:
    """The figures of all solvers in one motion."""

    cell: str
    motion: str
    dt: float  # [s]
    figures: list[SolverFigures]  # DAQP's come first.
    missing: list[str]  # Names of solvers that are not installed.


def run_solvers(
    config: Config,
    names: Sequence[str] = SOLVERS,
    progress: Callable[[str], None] = lambda what: None,
    motion: WorkMotion = CONTACT,
) -> SolverReport:
    """Run ``motion``, made for ``config/dual_iiwa7.yaml``, with DAQP and each solver of ``names`` that is installed."""
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
    """Return the largest distance between a tool's positions in this run and in the ``other`` one, at a tick [mm]."""
    ticks = min(len(run.q), len(other.q))
    if not ticks:
        return None
    tools = [
        [[robot.tool_pose(q, arm).translation for arm in robot.arms] for q in one.q[:ticks]] for one in (run, other)
    ]
    return 1e3 * float(np.linalg.norm(np.array(tools[0]) - np.array(tools[1]), axis=-1).max())
