"""The q2r2 command, as a user or a script calls it."""

from __future__ import annotations

import re
from contextlib import nullcontext
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.errors import ConfigError
from q2r2_control.verification.soak import SoakReport, run_soak
from tests.cli.command import CELL, FAST, changed_cell, external_cell, one_object, q2r2


def test_the_printed_version_is_the_version_of_the_installed_package() -> None:
    assert q2r2("--version").stdout == f"q2r2 {version('q2r2_control')}\n"


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ((), "Missing command"),
        (("rum",), "'rum'"),
        (("run",), "CONFIG"),
        (("run", "nowhere.yaml"), "nowhere.yaml: no such file"),
        (("run", CELL, "--input", "mind"), "'mind'"),
        (
            ("run", CELL, "--plant", "kinematic", "--mode", "torque", "--duration", "1"),
            "mode 'torque': KinematicPlant follows position, velocity commands only",
        ),
        (("run", CELL, "--duration", "nan"), "--duration nan: allowed"),
        (("run", CELL, "--fast"), "--fast needs --duration"),
        (
            ("run", CELL, "--input", "headset", "--fast", "--duration", "1"),
            "--fast cannot be used with --input headset",
        ),
        (("run", CELL, "--input", "headset", "--trajectory", "circle"), "--trajectory"),
        (("run", CELL, "--port", "0"), "--port"),
        (("run", CELL, "--viewer", "--headless"), "--viewer"),
        (("run", CELL, "--task", "something"), "--task needs --record"),
        (("run", CELL, "--operator", "Ada"), "--operator needs --record"),
        (("run", CELL, "--anonymous"), "--anonymous needs --record"),
        (("demo", "--anonymous"), "--anonymous needs --record"),
        (("demo", "juggle"), "task 'juggle': allowed: meet, clash, grasp, carry"),
        (("demo", "--fast", "--rt"), "exclude each other"),
        (("replay", "pyproject.toml"), "pyproject.toml"),
        (("replay", "missing.mcap"), "missing.mcap"),
        (("export", "mcap", "recordings", "--output", "out"), "export mcap: allowed: lerobot"),
        (("headset-check", "--host", "no such host"), "no such host"),
        (("headset-check", "--duration", "inf"), "--duration inf"),
        (("check", "pyproject.toml", "--pairs", "out.srdf"), "pyproject.toml"),
        (("bench", "--work", "--motion", "dance"), "motion 'dance': allowed: carry-"),
        (("bench", "--motion", "meet"), "needs --work"),
        *(
            ((*command, "--solver", "simplex"), "control.solver = 'simplex': installed: clarabel, daqp")
            for command in (("run", CELL), ("demo",), ("bench",), ("soak",))
        ),
        (("soak", "--ticks", "99"), "--ticks = '99': allowed: 100 or more; see"),
        (("soak", "--seed", "-1"), "--seed = '-1': allowed: 0 or more; see"),
        (("run", CELL, "--mode", "tork"), "--mode = 'tork': allowed: position, velocity, torque; see"),
        (("export", "csv", "x", "--output", "y", "--fps", "abc"), "--fps = 'abc': allowed: a whole number; see"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_bad_usage_ends_in_exit_code_2_and_one_line_that_names_the_fault(
    arguments: tuple[str, ...], named: str
) -> None:
    result = q2r2(*arguments)
    assert (result.exit_code, result.stdout, result.stderr.count("\n")) == (2, "", 1)
    assert result.stderr.startswith("q2r2: ")
    assert named in result.stderr


def test_a_cell_with_an_external_controller_is_not_run_without_ros(tmp_path: Path) -> None:
    result = q2r2("run", external_cell(tmp_path), "--plant", "kinematic", "--fast", "--duration", "1", "--headless")
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr == (
        "q2r2: dual_iiwa7: controller: external is driven by q2r2 ros up; this command runs controller: builtin only\n"
    )


def test_for_a_wrong_key_in_the_yaml_one_line_names_the_file_the_key_and_what_is_allowed(tmp_path: Path) -> None:
    result = q2r2("run", changed_cell(tmp_path, "obstacles:", "obstructions:"))
    assert (result.exit_code, result.stderr.count("\n")) == (2, 1)
    assert re.search(r"cell.yaml, line \d+: obstructions: unknown key; allowed here: .*obstacles", result.stderr)


@pytest.mark.slow
def test_a_fast_run_prints_one_json_object_and_nothing_else() -> None:
    arguments = (*FAST, "--duration", "1.2", "--human", "--seed", "7", "--trajectory", "circle")
    result = q2r2(*arguments)
    assert result.exit_code == 0
    summary = one_object(result.stdout)
    assert summary["arms"]["left"]["engaged_s"] > 0.3
    assert summary["events"][0].keys() == {"t", "arm", "from", "to", "kind", "detail", "reason"}


@pytest.mark.parametrize("option", ["--plant fri", "--viewer", "--rt", "--duration 4", "--seed 3", "--record rec"])
def test_options_of_a_single_run_are_refused_for_trials_of_a_demo(option: str) -> None:
    done = q2r2("demo", "grasp", "--seeds", "2", *option.split())
    assert done.exit_code == 2
    assert f"{option.split()[0]}" in done.stderr
    assert "cannot be used with --seeds" in done.stderr


@pytest.mark.slow
def test_a_failed_task_of_the_demo_is_explained_and_changes_the_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    coarse = load_config(CELL).model_copy(update={"loop_rate_hz": 200.0})
    monkeypatch.setattr("q2r2_control.cli.run.load_config", lambda path: coarse)
    monkeypatch.chdir(tmp_path)
    demo = ("demo", "grasp", "--fast", "--headless", "--mode", "position")
    early = q2r2(*demo, "--duration", "4", "--json")
    assert early.exit_code == 1
    (task,) = one_object(early.stdout)["tasks"]
    assert (task["name"], task["succeeded"]) == ("grasp", False)
    assert task["reason"].startswith("flat_block: held 95 mm up for 0.0 s")


@pytest.mark.slow
def test_bench_measures_ticks_in_free_motion_and_in_contact_or_in_the_chosen_work_motions() -> None:
    result = q2r2("bench", "--no-peers", "--rounds", "1", "--solver", "osqp")
    assert all(text in result.stdout for text in ("free motion", "contact (!)", "q2r2_control", "p99"))
    assert all(text in result.stdout for text in ("by QP solver", "daqp", "osqp", "unsolved"))
    report = one_object(q2r2("bench", "--work", "--no-peers", "--rounds", "1", "--motion", "reach", "--json").stdout)
    assert [row["motion"] for row in report["rows"]] == ["reach-under"]
    assert report["solvers"] is None


@pytest.mark.parametrize("command", [("run", CELL), ("demo",), ("demo", "--plant", "fri")], ids=" ".join)
def test_a_run_uses_the_solver_that_the_option_solver_names(
    command: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen: list[str] = []

    def run_cell(config: Config, options: Any) -> Any:
        chosen.append(config.control.solver)
        raise ConfigError("seen")

    monkeypatch.setattr("q2r2_control.cli.run.run_cell", run_cell)
    monkeypatch.setattr("q2r2_control.cli.fri.rehearsal", lambda *given, **named: nullcontext([]))
    for option in ((), ("--solver", "osqp")):
        assert "seen" in q2r2(*command, *option).stderr
    assert chosen == ["daqp", "osqp"]


def test_trials_of_a_demo_use_the_solver_that_the_option_solver_names(monkeypatch: pytest.MonkeyPatch) -> None:
    chosen: list[str] = []

    def try_tasks(tasks: Any, trial: partial[str], *given: Any) -> list[Any]:
        chosen.append(trial.args[0].control.solver)
        return []

    monkeypatch.setattr("q2r2_control.cli.run.try_tasks", try_tasks)
    assert q2r2("demo", "grasp", "--seeds", "1", "--solver", "osqp").exit_code == 0
    assert chosen == ["osqp"]


def test_a_soak_uses_and_reports_the_solver_that_the_option_solver_names() -> None:
    report = one_object(q2r2("soak", "--ticks", "100", "--solver", "osqp", "--json").stdout)
    assert (report["solver"], report["passed"]) == ("osqp", True)


@pytest.mark.slow
def test_a_soak_prints_every_promise_and_exits_with_0_if_all_were_kept() -> None:
    result = q2r2("soak", "--ticks", "400", "--seed", "1", "--json")
    report = one_object(result.stdout)
    assert (result.exit_code, report["passed"], report["ticks"]) == (0, True, 400)
    assert {margin["violations"] for margin in report["margins"]} == {0}
    assert "acceleration / limit" in q2r2("soak", "--ticks", "100").stdout


def test_a_soak_of_another_cell_names_the_cell_and_checks_its_additional_promises(tmp_path: Path) -> None:
    cell = tmp_path / "cell.yaml"
    text = Path(CELL).read_text(encoding="utf-8").replace("jerk_limit: null", "jerk_limit: 5000.0")
    cell.write_text(text.replace("name: dual_iiwa7", "name: limited"), encoding="utf-8")
    report = one_object(q2r2("soak", str(cell), "--ticks", "400", "--json").stdout)
    checked = {margin["name"]: margin["checked"] for margin in report["margins"]}
    assert (report["cell"], report["passed"]) == ("limited", True)
    assert checked["jerk of averaged commands / limit"] > 0


def test_a_soak_that_finds_a_broken_promise_exits_with_1(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*arguments: Any) -> SoakReport:
        report = run_soak(*arguments)
        report.margins[0].note(1.0, 7)
        return report

    monkeypatch.setattr("q2r2_control.cli.bench.run_soak", broken)
    result = q2r2("soak", "--ticks", "100", "--json")
    assert result.exit_code == 1
    assert not one_object(result.stdout)["passed"]
