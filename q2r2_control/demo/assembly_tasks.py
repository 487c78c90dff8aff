"""Small assembly tasks of two arms in simulation, and their results, which the simulation measures."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from q2r2_control.config.bindings import Action
from q2r2_control.config.cell import Config
from q2r2_control.demo.contact_judges import PegJudge, WipeJudge
from q2r2_control.demo.part_judges import CarryJudge, HandoverJudge, Judge, LiftJudge, StackJudge, Toucher, TouchWatch
from q2r2_control.errors import ConfigError
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.run_summary import RunSummary
from q2r2_control.summary.tick import Tick

if TYPE_CHECKING:
    from q2r2_control.plants.mujoco import MujocoPlant


@dataclass(frozen=True, slots=True)
class TaskResult:
    """The result of one task."""

    name: str
    succeeded: bool
    measured: dict[str, float]  # Numbers by name; the name ends with the unit.
    reason: str  # The reason of a failure; empty if the task succeeded.


@dataclass(frozen=True, slots=True)
class AssemblyTask:
    """A task in the cell config/dual_iiwa7.yaml. :data:`q2r2_control.inputs.assembly.WORKS` has its hand motion."""

    name: str
    about: str
    parts: tuple[str, ...]
    judges: Callable[[dict[str, float]], tuple[Judge, ...]]  # Makes the judges from the heights of the parts [m].
    pressed: tuple[str, ...] = ()  # The parts whose force on the table counts.


_ALL = (
    AssemblyTask(
        "meet",
        "each hand lifts a block, both meet in the middle, each puts its block back",
        ("blue_block", "yellow_block"),
        lambda parts: tuple(map(LiftJudge, parts)),
    ),
    AssemblyTask(
        "clash",
        "as meet, but the hands lead the arms into each other, and the arms refuse",
        ("blue_block", "yellow_block"),
        lambda parts: tuple(map(LiftJudge, parts)),
    ),
    AssemblyTask(
        "grasp",
        "a block of 15 mm is taken from the table and put back",
        ("flat_block",),
        lambda parts: tuple(map(LiftJudge, parts)),
    ),
    AssemblyTask(
        "carry",
        "one hand leads both arms, which lift a tray, carry it level and put it back",
        ("tray",),
        lambda parts: tuple(map(CarryJudge, parts)),
    ),
    AssemblyTask(
        "handover",
        "the left hand gives a bar of 120 mm to the right one, in the air",
        ("bar",),
        lambda parts: (HandoverJudge(next(iter(parts)), Toucher.LEFT_FINGER, Toucher.RIGHT_FINGER),),
    ),
    AssemblyTask(
        "stack",
        "three blocks on each other, one by the left hand and one by the right",
        ("green_block", "blue_block", "yellow_block"),
        lambda parts: (StackJudge(parts),),
    ),
    AssemblyTask(
        "wipe",
        "a sponge is moved over the table and pressed on with 5 to 15 N",
        ("sponge",),
        lambda parts: tuple(map(WipeJudge, parts)),
        pressed=("sponge",),
    ),
    AssemblyTask(
        "peg",
        "a peg of 20 mm is put into a hole of 21 mm",
        ("peg", "socket"),
        lambda parts: (PegJudge(parts),),
    ),
)
TASKS: dict[str, AssemblyTask] = {task.name: task for task in _ALL}
ALL_TASKS = "all"
_TASK_CONTROLS = {"grip": Action.CARRY, "stick_up": Action.PRECISION}


def tasks_named(names: Iterable[str]) -> tuple[AssemblyTask, ...]:
    """Return tasks of ``q2r2 demo``.

    Args:
        names: The names of tasks, such as ``grasp``, or ``all``.

    Returns:
        The tasks, each once, in an order in which they can be done one after the other.

    Raises:
        ConfigError: If a name is unknown.
    """
    wanted = set(names)
    if unknown := sorted(wanted - {*TASKS, ALL_TASKS}):
        raise ConfigError(f"task {unknown[0]!r:.60}: allowed: {', '.join((*TASKS, ALL_TASKS))}")
    return tuple(task for name, task in TASKS.items() if name in wanted or ALL_TASKS in wanted)


def note_on_parts(motion: str, config: Config) -> str | None:
    """Return one line about parts that the tasks of a scripted motion need and the cell lacks; None if it has all."""
    parts = [part for name in motion.split("+") if name in TASKS for part in TASKS[name].parts]
    if not (missing := [part for part in parts if part not in config.mujoco.objects]):
        return None
    hands = f"the hands of {motion} move as if they were there"
    return f"{config.name} has no {', '.join(missing)} under mujoco.objects: {hands}"


def with_controls(config: Config) -> Config:
    """Return the cell with controls for ``carry`` and ``precision``, because tasks need both.

    A control is added only for an action that has no control in the cell yet.
    """
    bindings = config.teleop.bindings
    given = {control: action for control, action in _TASK_CONTROLS.items() if bindings.words_of(action) is None}
    teleop = config.teleop.model_copy(update={"bindings": bindings.model_copy(update=given)})
    return config.model_copy(update={"teleop": teleop})


def with_parts_at(config: Config, tasks: Iterable[AssemblyTask], place: tuple[float, float]) -> Config:
    """Return the cell with all parts of ``tasks`` displaced by ``place`` (x, y) [m]."""
    parts = {part for task in tasks for part in task.parts}
    objects = {
        name: item.model_copy(
            update={"position": (item.position[0] + place[0], item.position[1] + place[1], item.position[2])}
        )
        if name in parts
        else item
        for name, item in config.mujoco.objects.items()
    }
    return config.model_copy(update={"mujoco": config.mujoco.model_copy(update={"objects": objects})})


def held_to_promises(results: Iterable[TaskResult], summary: RunSummary) -> tuple[TaskResult, ...]:
    """Return the ``results``. If the run broke a promise, all returned results are failures."""
    results = tuple(results)
    if not summary.broken:
        return results
    reasons = ("; ".join(filter(None, (result.reason, *summary.broken))) for result in results)
    return tuple(replace(one, succeeded=False, reason=why) for one, why in zip(results, reasons, strict=True))


class TaskWatch:
    """A listener of a run that judges tasks from the state of the simulation."""

    def __init__(self, tasks: Iterable[AssemblyTask], plant: MujocoPlant, robot: Robot, config: Config) -> None:
        """Prepare to judge a run.

        Args:
            tasks: The tasks, as :func:`tasks_named` returns them.
            plant: The simulation of the run.
            robot: The robot of the run.
            config: The cell of the run.

        Raises:
            ConfigError: If the cell lacks a part of the tasks.
        """
        tasks = tuple(tasks)
        for task in tasks:
            if missing := [part for part in task.parts if part not in config.mujoco.objects]:
                raise ConfigError(f"task {task.name}: {config.name} has no {missing[0]} under mujoco.objects")
        heights = {name: item.size[2] for name, item in config.mujoco.objects.items()}
        self._judges = {task.name: task.judges({part: heights[part] for part in task.parts}) for task in tasks}
        parts = tuple(part for task in tasks for part in task.parts)
        pressed = tuple(part for task in tasks for part in task.pressed)
        self._touches = TouchWatch(plant, robot, parts, tuple(config.mujoco.objects), pressed)

    def __call__(self, tick: Tick) -> None:
        """Look at the parts after this tick."""
        self.look(tick.t, tick.dt)

    def look(self, t: float, dt: float) -> None:
        """Look at the parts at time ``t`` [s]. The last call was ``dt`` [s] earlier."""
        parts = self._touches.look(t)
        for judges in self._judges.values():
            for judge in judges:
                judge.see(dt, parts)

    def results(self) -> tuple[TaskResult, ...]:
        """Return the results of all tasks. All of them fail if an arm touched anything except parts in its fingers."""
        touches = [f"{one} touched {other} at {t:.1f} s" for (one, other), t in self._touches.forbidden.items()]
        results = []
        for name, judges in self._judges.items():
            faults = [*(fault for judge in judges for fault in judge.faults()), *touches]
            measured: dict[str, float] = {}
            for judge in judges:
                prefix = f"{judge.parts[0]}_" if len(judges) > 1 else ""
                measured |= {f"{prefix}{what}": value for what, value in judge.measured().items()}
            results.append(TaskResult(name, not faults, measured, "; ".join(faults)))
        return tuple(results)
