"""``q2r2 commission``: commission two arms behind real cabinets. Each step must pass before the next one begins."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from rich.console import Console
from typer import Exit, Option

from q2r2_control.cli.fri_check import listen
from q2r2_control.cli.mounts import Tip, measure_mount, postures_over
from q2r2_control.cli.output import ConfigFile, Json, as_json_text, notice_of_compiling, say
from q2r2_control.config.cell_file import load_config, parse_config
from q2r2_control.config.mount_text import with_mount
from q2r2_control.config.resources import find_resource
from q2r2_control.errors import ConfigError, PlantError, Q2R2Error
from q2r2_control.pipeline.commissioning import LoadSurvey, StopReport, measure_joint, measure_stop
from q2r2_control.pipeline.killed_run import measure_kill
from q2r2_control.pipeline.slow_run import REST, STILL, SlowRun
from q2r2_control.plants.fri.plant import FriPlant
from q2r2_control.process.folders import check_file
from q2r2_control.process.program import program
from q2r2_control.process.scheduling import real_time
from q2r2_control.robot.commissioned import fingerprint, sign_off_file
from q2r2_control.robot.robot import Robot
from q2r2_control.types import SIDES, Array, CommandMode
from q2r2_control.viewer.tables import figure_table, print_table, record_table

_MOST_LOST = 0.01  # Largest share of a cabinet's messages that may be lost.
_POINTS = 3  # Number of points that both tools' tips touch.
_GUIDED = 1.0  # A joint counts as guided by hand if it has moved by more than this [deg].
_Measured = TypeVar("_Measured")


class _Commissioning:
    """The steps of commissioning, with their questions to the operator.

    Each step returns its figures, or raises :class:`Q2R2Error` if it is not passed.
    """

    def __init__(self, file: Path, duration: float, tip: tuple[float, float, float]) -> None:
        self.file, self.config = file, load_config(file)
        self._duration, self._tip, self._console = duration, np.array(tip), Console(stderr=True)
        self._robot = Robot.from_config(self.config)
        self._plant = FriPlant(self._robot, self.config)
        self.step = ""  # The name of the current step.
        self.seen: dict[str, Any] = {}
        self._repeats = 0  # Number of measurements that the operator repeated.

    def run(self, stack: ExitStack) -> None:
        """Do all steps. Closing ``stack`` also closes the connection to the cabinets."""
        self._plant.begin(CommandMode.POSITION)
        stack.callback(self._plant.close)
        self._do("cabinets", f"listens for {self._duration:g} s, and moves nothing", self._cabinets)
        self._do("joints", "you guide each arm by hand, and see its joints change", self._joints)
        self._do("mounts", "where the arms' bases are", self._mounts)
        self._plant.close()
        self._ask(
            "the arms move next, slowly. Keep people out and the emergency stop in your hand, let each tool have "
            "100 mm of room above it, start the application that lets this program command, and press Enter"
        )
        say("waits until the cabinets command", self._console)
        with ExitStack() as moving:
            run = self._tried(lambda: moving.enter_context(self._slow_run()))
            self._do("motion", "each joint goes a degree and back, one after the other", lambda: self._motion(run))
            self._do("load", "the arms go through eight postures", lambda: self._load(run))
            self._do("stop", "each tool goes up for two seconds, and a hand lets go", lambda: self._stop(run))
        self._do("kill", "both tools go up for two seconds, and the program that leads them is killed", self._kill)

    def signed(self) -> dict[str, Any]:
        """Ask for the operator's name, and return the content of the sign-off."""
        self.step = "sign-off"
        name = ""
        while not name:
            name = self._ask("all steps are passed; your name, for the sign-off")
        return {
            "cell": self.config.name,
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "operator": name,
            "version": program()["version"],
            "fingerprint": fingerprint(self.config),
            "repeats": self._repeats,
            "steps": self.seen,
        }

    def _do(self, name: str, what: str, step: Callable[[], Any]) -> None:
        self.step = name
        say(f"step {len(self.seen) + 1} of 7, {name}: {what}", self._console, "bold")
        self.seen[name] = step()

    def _cabinets(self) -> list[dict[str, Any]]:
        def listened() -> list[dict[str, Any]]:
            self._plant.reset()
            heard = listen(self._plant, self._duration)
            print_table(heard.table(self._duration), self._console)
            for its in heard.cabinets:
                lost = its.lost / (its.lost + its.messages)
                if its.quality not in ("good", "excellent") or lost > _MOST_LOST or its.safety != "normal":
                    raise PlantError(
                        f"{its.arm}: connection {its.quality}, {100.0 * lost:.1f} % lost, safety {its.safety}; "
                        f"allowed: good or excellent, {100.0 * _MOST_LOST:g} %, normal; see to the network, to this "
                        "computer's load, and to the pendant"
                    )
            return [asdict(its) for its in heard.cabinets]

        return self._tried(listened)

    def _joints(self) -> dict[str, dict[str, Any]]:
        return {arm: self._guided(arm) for arm in self._robot.arms}

    def _guided(self, arm: str) -> dict[str, Any]:
        """Let the operator guide an arm by hand, and confirm the joints that changed.

        Return whether a joint moved, the change of each joint [deg], and the displacement of the tool [mm].
        """
        joints = self._robot.arms[arm].joints
        names = [self._robot.joint_names[joint] for joint in joints]
        start = postures_over(self._plant, 0.1)[-1]
        question = f"guide the {arm} arm by hand, joint by joint, and press Enter"
        while True:
            self._ask(question)
            q = postures_over(self._plant, 0.1)[-1]
            before, now = np.degrees(start[joints]), np.degrees(q[joints])
            way = self._robot.tool_pose(q, arm).translation - self._robot.tool_pose(start, arm).translation
            way_mm = (1e3 * way).round().astype(int).tolist()
            notes = ["its tool went {} mm forwards (x), {} left (y), {} up (z)".format(*way_mm)]
            rows = zip(names, before.tolist(), now.tolist(), (now - before).tolist(), strict=True)
            columns = ("joint", "before [deg]", "now [deg]", "change [deg]")
            print_table(figure_table(f"{arm} arm", columns, rows, notes), self._console)
            moved = bool(np.abs(now - before).max() > _GUIDED)
            if not moved:
                say(f"the {arm} arm's joints have not moved", self._console, "yellow")
            yes = "y" if moved else "confirm"
            answer = self._ask("are these the arm, the joints and the signs that you saw", yes, "again", "n")
            if answer == "n":
                raise PlantError(
                    f"the {arm} arm's joints are not those that moved; see to fri.*.port, which names the arm, to the "
                    "cabinet's address, and to the model"
                )
            if answer == yes:
                return {"moved": moved, "change_deg": (now - before).round(2).tolist(), "tool_mm": way_mm}

    def _mounts(self) -> dict[str, Any]:
        kept = {"measured": False}
        if set(self.config.arms) != set(SIDES) or self.config.robot is not None:
            return kept
        if self._ask("keep the mounts of the YAML, or measure that of the right arm", "keep", "measure") == "keep":
            return kept
        report = self._tried(
            lambda: measure_mount(self._plant, self.config, self._robot, _POINTS, self._tip, self._console)
        )
        print_table(report.table(), self._console)
        if report.fault is not None:
            raise PlantError(report.fault)
        if self._ask(f"write this mount into {self.file}", "y", "n") == "y":
            self._write_mount(report.position, report.rpy)
            return {"measured": True, **asdict(report)}
        return kept

    def _write_mount(self, position: Sequence[float], rpy: Sequence[float]) -> None:
        text = with_mount(self.file.read_text(encoding="utf-8"), SIDES[1], position, rpy)
        self.config = parse_config(text, self.file, self.file.absolute().parent)
        self.file.write_text(text, encoding="utf-8")

    def _slow_run(self) -> SlowRun:
        with notice_of_compiling():
            return SlowRun(self.config, FriPlant)

    def _motion(self, run: SlowRun) -> list[dict[str, Any]]:
        reports = []
        for arm in run.robot.arms.values():
            say(f"the {arm.name} arm moves", self._console)
            for joint in arm.joints.tolist():
                reports.append(self._tried(partial(measure_joint, run, joint), run))
        columns = ("joint", "commanded [deg]", "measured [deg]", "behind [deg]", "others [deg]")
        rows = [tuple(asdict(report).values()) for report in reports]
        print_table(figure_table("joints", columns, rows), self._console)
        return [asdict(report) for report in reports]

    def _load(self, run: SlowRun) -> list[dict[str, Any]] | None:
        survey = LoadSurvey(run)
        reports = self._tried(survey.measure, run)
        if reports is None:
            say("the cabinets give no measured torques, so no load is identified", self._console, "yellow")
            return None
        figures = [tuple(asdict(report).values()) for report in reports]
        columns = ("arm", "against", "found [kg]", "expected [kg]", "found [mm]", "expected [mm]", "unexplained [Nm]")
        rows = [[" ".join(map(str, cell)) if isinstance(cell, list) else cell for cell in row] for row in figures]
        print_table(figure_table("loads, centres in the flange's frame", columns, rows), self._console)
        for report in reports:
            report.check()
            if not report.is_judged:
                why = f"no load explains {report.residual_nm:.1f} Nm, so the masses of the arm's own model are wrong"
                say(f"the {report.arm} arm's load is not judged by the model: {why}", self._console, "yellow")
        return [asdict(report) for report in reports]

    def _stop(self, run: SlowRun) -> list[dict[str, Any]]:
        reports = [self._tried(partial(measure_stop, run, arm), run) for arm in run.robot.arms]
        print_table(record_table("stops", reports), self._console)
        return [asdict(report) for report in reports]

    def _kill(self) -> list[dict[str, Any]]:
        def killed() -> list[StopReport]:
            self._ask("start the application that lets this program command once more, and press Enter")
            return [report.check() for report in measure_kill(self.config, self._resting)]

        reports = self._tried(killed)
        print_table(record_table("stops", reports), self._console)
        return [asdict(report) for report in reports]

    def _resting(self) -> Array:
        """Return the measured posture (nv,) [rad] while no commands are sent.

        Raises :class:`PlantError` if the arms move.
        """
        self._plant.reset()
        try:
            seen = postures_over(self._plant, REST)
        finally:
            self._plant.close()
        if (moved := float(np.ptp(seen, axis=0).max())) > STILL:
            raise PlantError(f"the arms moved by {moved:.4f} rad although nothing commands them; allowed: {STILL:g}")
        return np.asarray(seen[-1])

    def _tried(self, measure: Callable[[], _Measured], run: SlowRun | None = None) -> _Measured:
        """Return the result of ``measure``. If it raises an error, the operator may repeat it.

        If the error has ended ``run``, it is raised again.
        """
        while True:
            try:
                return measure()
            except Q2R2Error as error:
                if run is not None and run.is_over:
                    raise
                say(str(error), self._console, "red")
                if self._ask("try again", "y", "n") == "n":
                    raise
                self._repeats += 1

    def _ask(self, question: str, *allowed: str) -> str:
        """Ask the operator a question, and return the answer. Without ``allowed`` answers, any line is an answer."""
        say(f"{question} [{'/'.join(allowed)}]" if allowed else question, self._console)
        while line := sys.stdin.readline():
            answer = line.strip()
            if not allowed or answer in allowed:
                return answer
            say(f"allowed: {', '.join(allowed)}", self._console)
        raise ConfigError(f"no more input; allowed: {', '.join(allowed) or 'a line'}")


def commission(
    config: ConfigFile,
    duration: Annotated[
        float, Option(min=1, max=3600, help="Time for which the messages of the cabinets are measured [s].")
    ] = 60.0,
    tip: Tip = (0.0, 0.0, 0.0),
    json: Json = False,
) -> None:
    """Commission the arms behind real cabinets step by step, with questions to you and with measurements.

    The steps are: cabinets, joints, mounts, motion of each joint, loads, stops, and a kill of the process. After them,
    a sign-off is written beside the cell. Without it, q2r2 run asks for --i-know. The arms move at 5 % of their speed.
    Exit code 1 if a step is not passed; then no sign-off is written.
    """
    work = _Commissioning(find_resource(config), duration, tip)
    sign_off = sign_off_file(work.file)
    check_file(sign_off, "sign-off")
    logger = logging.getLogger("q2r2_control")
    try:
        with ExitStack() as stack:
            stack.callback(logger.setLevel, logger.level)
            logger.setLevel(logging.ERROR)  # Warnings are not logged, because the steps report what went wrong.
            # With an ordinary priority, this thread could hold Python's global lock while the loop waits for the lock.
            stack.enter_context(real_time())
            work.run(stack)
        signed = work.signed()
        sign_off.write_text(as_json_text(signed) + "\n", encoding="utf-8")
    except (Q2R2Error, KeyboardInterrupt, OSError) as error:
        why = "stopped by Ctrl-C" if isinstance(error, KeyboardInterrupt) else " ".join(str(error).split())
        print(f"q2r2: {work.step}: {why}; the cell is not commissioned", file=sys.stderr)
        raise Exit(1) from None
    if json:
        print(as_json_text(signed))
    say(f"commissioned: {sign_off}", Console(stderr=True))
