"""``q2r2 commission``, step by step, with a person's answers, and ``q2r2 run`` before and after it."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.cli.commission import _Commissioning
from q2r2_control.cli.fri_check import CabinetReport, Heard
from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.resources import find_resource
from q2r2_control.pipeline.commissioning import _SPREAD, JointMotion, LoadSurvey, StopReport
from q2r2_control.pipeline.slow_run import SlowRun
from q2r2_control.plants.fri.plant import FriPlant
from q2r2_control.robot.commissioned import fingerprint
from q2r2_control.robot.load import MODEL, PENDANT, LoadReport
from q2r2_control.robot.robot import Robot
from q2r2_control.types import SIDES, Array
from tests.cli.command import q2r2
from tests.pipeline.slow_cell import PendantCabinets, StuckArm, slow_run
from tests.plants.fri.conftest import free_ports
from tests.plants.fri.waiting_cabinets import waiting_cabinets

MODULE = "q2r2_control.cli.commission"
GUIDED = ["", "y", "", "y"]  # Answers of an operator who guides both arms and sees the right joints move.
TO_THE_END = [*GUIDED, "keep", "", "", "Ada"]
GOOD = CabinetReport(
    "left", 2, 10.0, 100, 0, 0.1, 0.1, "monitoring ready", "excellent", "normal", "t1", "off", [0.0] * 7, 0.0
)


@pytest.fixture
def cell(tmp_path: Path) -> Path:
    """Return a cell with real cabinets that do not answer.

    It has few ticks per second, because ticks take most of the time of a test.
    """
    text = find_resource("config/dual_iiwa7_fri.yaml").read_text(encoding="utf-8").replace("127.0.0.2", "192.0.2.1")
    text = text.replace("loop_rate_hz: 500.0", "loop_rate_hz: 250.0")
    (file := tmp_path / "my_cell.yaml").write_text(text, encoding="utf-8")
    return file


@pytest.fixture
def virtual(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Replace real cabinets by cabinets in virtual time, whose arms are guided by a quarter of a radian."""

    def use(
        run: Callable[[Config], SlowRun] = slow_run,
        report: CabinetReport = GOOD,
        guided: float = 0.25,
        stopped_mm: float = 1.0,
    ) -> None:
        killed = [StopReport(arm, "program killed", 30.0, stopped_mm, 4.5, 0.1, 0.16) for arm in SIDES]
        heard = Heard([report, replace(GOOD, arm="right")], np.zeros(0), None, [])
        at = iter(np.arange(0.0, 100.0 * guided + 1.0, guided) if guided else np.zeros(100))

        def postures(plant: FriPlant, duration: float) -> Array:
            return np.full((1, 14), next(at))

        monkeypatch.setattr(FriPlant, "reset", lambda plant: None)
        monkeypatch.setattr(f"{MODULE}.listen", lambda plant, duration: heard)
        monkeypatch.setattr(f"{MODULE}.postures_over", postures)
        monkeypatch.setattr(f"{MODULE}.SlowRun", lambda config, plant: run(config))
        monkeypatch.setattr(f"{MODULE}.measure_kill", lambda config, posture: killed)

    return use


def commission(cell: Path, answers: list[str], *options: str) -> tuple[int, list[str], str]:
    """Return exit code, lines on stderr, and stdout."""
    done = q2r2("commission", str(cell), "--duration", "1", *options, typed="".join(f"{line}\n" for line in answers))
    return done.exit_code, done.stderr.splitlines(), done.stdout


def refused(cell: Path, answers: list[str]) -> str:
    """Return the only line about the failure of a commissioning, which must leave no sign-off."""
    code, lines, _ = commission(cell, answers)
    assert code == 1
    assert lines[-1].startswith("q2r2: ")
    assert lines[-1].endswith("; the cell is not commissioned")
    assert [line for line in lines if line.startswith("q2r2: ")] == lines[-1:]
    assert list(cell.parent.glob("*.json")) == []
    return lines[-1]


@pytest.mark.slow
def test_a_cell_that_passes_all_steps_is_signed_off_and_may_run(
    cell: Path, virtual: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    virtual()
    # Without noise, postures that are nearer to each other are sufficient, and slow arms reach them sooner.
    monkeypatch.setattr("q2r2_control.pipeline.commissioning._SPREAD", 0.4 * _SPREAD)
    before = q2r2("run", str(cell), "--input", "scripted")
    assert before.exit_code == 2
    assert f"q2r2 commission {cell}" in before.stderr
    assert "--i-know" in before.stderr
    code, lines, out = commission(cell, TO_THE_END, "--json")
    assert code == 0, "\n".join(lines)
    kept = json.loads((cell.parent / "my_cell.commissioned.json").read_text(encoding="utf-8"))
    assert kept == json.loads(out)
    assert (kept["operator"], kept["fingerprint"], kept["repeats"]) == ("Ada", fingerprint(load_config(cell)), 0)
    assert list(kept["steps"]) == ["cabinets", "joints", "mounts", "motion", "load", "stop", "kill"]
    assert [len(kept["steps"][name]) for name in ("motion", "load", "stop", "kill")] == [14, 4, 2, 2]
    assert [load["against"] for load in kept["steps"]["load"]] == [MODEL, PENDANT] * 2
    for load in kept["steps"]["load"]:
        assert load["identified_kg"] == pytest.approx(load["expected_kg"], abs=0.01)
    after = q2r2("run", str(cell), "--input", "scripted", "--trajectory", "nowhere")
    assert "nowhere" in after.stderr  # The cell was allowed to run. The run ended only because of this wrong option.
    assert "joints at a tenth of their speed" in after.stderr
    assert "a tenth" not in q2r2("run", str(cell), "--trajectory", "nowhere", "--full-speed").stderr
    cell.write_text(cell.read_text(encoding="utf-8").replace("192.0.2.1", "192.0.2.2"), encoding="utf-8")
    assert "were changed since" in q2r2("run", str(cell), "--input", "scripted").stderr


@pytest.mark.slow
def test_a_commissioning_over_real_sockets_and_processes_goes_through_all_steps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = find_resource("config/dual_iiwa7_fri.yaml").read_text(encoding="utf-8")
    for port, free in zip((30200, 30201), free_ports(2), strict=True):
        text = text.replace(f"port: {port}", f"port: {free}")
    (cell := tmp_path / "my_cell.yaml").write_text(text, encoding="utf-8")
    config = load_config(cell)
    answers = ["confirm", "confirm", "keep", "Ada"]
    ask, tries = _Commissioning._ask, iter(range(5))

    def asked(work: _Commissioning, question: str, *allowed: str) -> str:
        """Answer as an operator who repeats a step that a busy computer has spoiled, but only a few times."""
        if question == "try again" and next(tries, None) is not None:
            return "y"
        return "" if "press Enter" in question else ask(work, question, *allowed)

    monkeypatch.setattr(_Commissioning, "_ask", asked)
    # On a busy machine, threads wait for milliseconds, so that cabinets with a shorter period would fall ever further
    # behind.
    with waiting_cabinets(Robot.from_config(config), config, period=0.02):
        code, lines, out = commission(cell, answers, "--json")
    assert code == 0, "\n".join(lines)
    steps = json.loads(out)["steps"]
    assert all(its["quality"] == "excellent" for its in steps["cabinets"])
    assert [len(steps[name]) for name in ("motion", "stop", "kill")] == [14, 2, 2]
    for stop in (*steps["stop"], *steps["kill"]):
        assert stop["tool_speed_mm_s"] > 10.0


def test_a_sign_off_that_cannot_be_written_is_refused_before_the_first_step(cell: Path) -> None:
    (file := cell.with_name("my_cell.commissioned.json")).mkdir()
    code, lines, _ = commission(cell, [])
    assert code == 2
    assert lines[0].startswith(f"q2r2: sign-off {file}: Is a directory; allowed: a file in a folder")
    assert len(lines) == 1


def test_with_the_option_i_know_a_cell_runs_without_a_sign_off(cell: Path) -> None:
    done = q2r2("run", str(cell), "--input", "scripted", "--trajectory", "nowhere", "--i-know")
    assert "nowhere" in done.stderr


def test_simulated_cabinets_need_no_sign_off() -> None:
    done = q2r2("run", "config/dual_iiwa7_fri.yaml", "--input", "scripted", "--trajectory", "nowhere")
    assert "nowhere" in done.stderr
    assert "a tenth" not in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("report", "told"),
    [
        (replace(GOOD, quality="fair"), "left: connection fair"),
        (replace(GOOD, lost=3), "2.9 % lost"),
        (replace(GOOD, safety="stop 1 on path"), "safety stop 1 on path"),
    ],
    ids=["poor connection", "lost messages", "safety stop"],
)
def test_the_operator_may_repeat_the_step_cabinets_after_a_poor_connection_or_a_safety_stop(
    cell: Path, virtual: Callable[..., None], report: CabinetReport, told: str
) -> None:
    virtual(report=report)
    line = refused(cell, ["y", "n"])
    assert line.startswith("q2r2: cabinets: ")
    assert told in line


def test_the_commissioning_ends_if_the_operator_does_not_recognise_the_joints_that_moved(
    cell: Path, virtual: Callable[..., None]
) -> None:
    virtual()
    assert "the right arm's joints are not those that moved" in refused(cell, ["", "y", "", "n"])


def test_for_an_arm_that_was_not_guided_the_operator_has_to_answer_confirm(
    cell: Path, virtual: Callable[..., None]
) -> None:
    virtual(guided=0.0)
    code, lines, _ = commission(cell, ["", "y", "confirm", "", "again", "", "n"])
    assert code == 1
    assert "the left arm's joints have not moved" in lines
    assert "allowed: confirm, again, n" in lines
    assert lines.count("the right arm's joints have not moved") == 2


@pytest.mark.parametrize("answers", [[], [*GUIDED, "keep"]])
def test_the_end_of_the_input_ends_the_commissioning(
    cell: Path, virtual: Callable[..., None], answers: list[str]
) -> None:
    virtual()
    assert "no more input; allowed: " in refused(cell, answers)


@pytest.mark.slow
def test_the_commissioning_ends_in_the_motion_step_if_an_arm_does_not_move(
    cell: Path, virtual: Callable[..., None]
) -> None:
    virtual(partial(slow_run, arm=StuckArm))
    line = refused(cell, [*TO_THE_END[:-1], "n"])
    assert line.startswith("q2r2: motion: left_A1: commanded")


def test_the_commissioning_ends_in_the_load_step_if_a_tool_is_heavier_than_its_model(
    cell: Path, virtual: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    virtual()
    at = [0.0, 0.0, 50.0]
    monkeypatch.setattr(f"{MODULE}.measure_joint", lambda run, joint: JointMotion("A1", 1.0, 1.0, 0.1, 0.0))
    monkeypatch.setattr(LoadSurvey, "measure", lambda survey: [LoadReport("left", MODEL, 1.86, 1.06, at, at, 0.1)])
    assert refused(cell, TO_THE_END).startswith("q2r2: load: the left arm carries 1.86 kg")


def test_the_commissioning_ends_if_arms_go_on_moving_when_their_program_is_killed(
    cell: Path, virtual: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    virtual(stopped_mm=5.0)
    for step in ("_motion", "_load", "_stop"):
        monkeypatch.setattr(f"{MODULE}._Commissioning.{step}", lambda commissioning, run: [])
    line = refused(cell, [*TO_THE_END[:-1], "n"])
    assert line.startswith("q2r2: kill: the left arm, program killed, stopped after 5.0 mm")


@pytest.fixture
def interrupted(virtual: Callable[..., None]) -> Iterator[list[PendantCabinets]]:
    """Press Ctrl-C while the left arm moves, as in a terminal, whatever signal handlers this process has."""
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    made: list[PendantCabinets] = []

    def prepare(cabinets: PendantCabinets) -> None:
        made.append(cabinets)
        arm = cabinets.cabinets["left"].arm
        start = arm.q

        def press(side: str, now: float) -> None:
            if abs(arm.q[0] - start[0]) > 0.005:
                cabinets.on_message = lambda side, now: None
                os.kill(os.getpid(), signal.SIGINT)

        cabinets.on_message = press

    virtual(partial(slow_run, prepare=prepare))
    yield made
    signal.signal(signal.SIGINT, handler)


def test_ctrl_c_brings_the_arms_to_rest_before_it_ends_the_commissioning(
    cell: Path, interrupted: list[PendantCabinets]
) -> None:
    assert "motion: stopped by Ctrl-C" in refused(cell, TO_THE_END)
    for arm in SIDES:
        assert interrupted[0].cabinets[arm].trips == []
        path = interrupted[0].lines[arm].path
        assert np.abs(path.rest - path.at(path.end)).max() < 1e-9


def test_a_measured_mount_is_written_into_the_cell_if_the_operator_agrees(
    cell: Path, virtual: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    virtual()
    points = np.array([[0.5, 0.1, 0.3], [0.6, -0.2, 0.3], [0.4, 0.0, 0.5]])
    touched = {"left": iter(points), "right": iter(points + np.array([0.0, 0.01, 0.0]))}

    def rests(plant: FriPlant, arm: str, robot: Robot, console: object) -> pin.SE3:
        return pin.SE3(np.eye(3), next(touched[arm]))

    monkeypatch.setattr("q2r2_control.cli.mounts._resting", rests)
    monkeypatch.setattr(Robot, "tool_pose", lambda robot, q, arm: q if isinstance(q, pin.SE3) else pin.SE3.Identity())
    refused(cell, [*GUIDED, "measure", "y"])
    assert load_config(cell).arms["right"].mount.position == pytest.approx((0.0, -0.41, 0.0))
