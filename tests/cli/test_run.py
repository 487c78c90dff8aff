"""A run refuses a cell in which the check finds a fault, unless the option --force is given."""

from __future__ import annotations

import errno
import os
import platform
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer import Exit

from q2r2_control.cli.cell_run import CellRun, RunOptions, run_cell
from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config, parse_config
from q2r2_control.config.resources import find_resource
from q2r2_control.extras import install_line
from q2r2_control.recording.about import About
from q2r2_control.recording.reader import Recording
from tests.cli.command import CELL, FAST, changed_cell, one_object, q2r2
from tests.support.pictures import needs_opengl

MODULE = "q2r2_control.cli.run"
OPTIONS = (*FAST[2:], "--duration", "0.1")


def test_a_run_refuses_a_cell_that_check_refuses_and_prints_the_same_lines(tmp_path: Path) -> None:
    file = changed_cell(tmp_path, "home: [0.0204, 0.348,", "home: [0.0204, 1.0,")
    refused = q2r2("run", file, *OPTIONS)
    assert (refused.exit_code, refused.stdout) == (2, "")
    faults = one_object(q2r2("check", file, "--json").stdout)["faults"]
    assert faults
    *lines, allowed = refused.stderr.splitlines()
    assert [line.partition("dual_iiwa7: FAULT ")[2] for line in lines] == faults
    assert allowed == "q2r2: dual_iiwa7: --force runs it all the same"


def test_links_without_a_mass_are_all_named_by_the_check_and_by_a_run(tmp_path: Path) -> None:
    urdf = find_resource("robots/iiwa7.urdf").read_text(encoding="utf-8")
    inertials = re.compile(r"<inertial>.*?</inertial>", re.DOTALL)
    (tmp_path / "arm.urdf").write_text(inertials.sub("", urdf, count=4))
    file = changed_cell(tmp_path, "model: iiwa7", f"model: {tmp_path / 'arm.urdf'}")
    (fault,) = one_object(q2r2("check", file, "--json").stdout)["faults"]
    assert "links that move without a mass, which simulation needs: left_link_1, left_link_2, left_link_3; " in fault
    assert f"allowed: <inertial> with a mass in {tmp_path / 'arm.urdf'}, iiwa7" in fault
    refused = q2r2("run", file, "--headless", "--duration", "0.1", "--fast")
    assert (refused.exit_code, refused.stderr) == (2, f"q2r2: dual_iiwa7: FAULT {fault}\n")


def test_without_the_parts_of_a_task_a_note_says_that_the_hands_move_without_them(tmp_path: Path) -> None:
    file = changed_cell(tmp_path, "    bar:\n", "    rod:\n")
    result = q2r2("run", file, *OPTIONS, "--trajectory", "handover")
    assert (
        "dual_iiwa7 has no bar under mujoco.objects: the hands of handover move as if they were there" in result.stderr
    )
    assert "mujoco.objects" not in q2r2("run", CELL, *OPTIONS, "--trajectory", "handover").stderr


def test_with_the_option_force_a_faulty_cell_runs_and_its_faults_are_printed(tmp_path: Path) -> None:
    file = changed_cell(tmp_path, "0.0204, 0.348,", "0.0204, 2.09,")
    result = q2r2("run", file, *OPTIONS, "--force")
    assert result.exit_code == 1, "no stop can be proven where links are in the floor"
    assert "FAULT home: left_A2 = 2.09" in result.stderr
    assert one_object(result.stdout)["ticks"] > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "home", "said"),
    [
        ("position", "1.0,", "mm from its reference: the tool did not follow"),
        ("torque", "0.7,", "| table_0; what was measured broke what was promised"),
    ],
)
def test_if_an_arm_begins_inside_the_table_the_run_ends_with_exit_code_1(
    tmp_path: Path, mode: str, home: str, said: str
) -> None:
    file = changed_cell(tmp_path, "0.0204, 0.348,", f"0.0204, {home}")
    result = q2r2("run", file, "--mode", mode, "--fast", "--headless", "--duration", "0.1", "--force")
    assert result.exit_code == 1
    assert said in " ".join(result.stdout.split())


@pytest.mark.parametrize(
    ("change", "code"), [({}, 0), ({"uncertified_ticks": 3}, 1), ({"at_rest": False}, 1)], ids=["none", "proof", "rest"]
)
def test_the_exit_code_of_a_run_agrees_with_its_verdict(
    monkeypatch: pytest.MonkeyPatch, change: dict[str, Any], code: int
) -> None:
    def as_if(*given: Any) -> CellRun:
        done = run_cell(*given)
        return replace(done, summary=replace(done.summary, **change))

    monkeypatch.setattr(f"{MODULE}.run_cell", as_if)
    result = q2r2("run", CELL, *OPTIONS[:-1], "0.01")
    assert result.exit_code == code
    data = one_object(result.stdout)
    assert {name: data[name] for name in change} == change


@pytest.mark.parametrize("command", [("run", CELL, *OPTIONS), ("demo", "--fast", "--headless")])
def test_a_folder_for_recordings_that_cannot_be_written_is_refused_before_the_run(
    command: tuple[str, ...], tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    result = q2r2(*command, "--record", str(tmp_path / "file" / "recordings"))
    assert (result.exit_code, result.stdout, result.stderr.count("\n")) == (2, "", 1)
    assert f"--record {tmp_path / 'file' / 'recordings'}: Not a directory; allowed: a folder" in result.stderr
    result = q2r2(*command, "--record", str(tmp_path / "file"))
    assert f"--record {tmp_path / 'file'}: is a file; allowed: a folder" in result.stderr


def test_a_recording_that_ends_before_its_run_gives_exit_code_3(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("q2r2_control.recording.recorder.new_folder", full)
    result = q2r2("run", CELL, *OPTIONS, "--record", str(tmp_path))
    assert result.exit_code == 3
    assert one_object(result.stdout)["recording"]["fault"] == "No space left on device"


def full(*given: object) -> Path:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_an_empty_text_for_the_option_task_is_refused(tmp_path: Path) -> None:
    result = q2r2("run", CELL, *OPTIONS, "--record", str(tmp_path), "--task", " ")
    assert result.exit_code == 2
    assert "--task is empty; allowed: some words, or no --task" in result.stderr


def test_with_the_option_rt_one_line_names_what_the_system_refuses_and_the_run_goes_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    refusal = "real time: no SCHED_FIFO: Operation not permitted; the run goes on without"

    @contextmanager
    def refused() -> Iterator[str]:
        yield refusal

    monkeypatch.setattr("q2r2_control.cli.cell_run.real_time", refused)
    options = ("run", FAST[1], "--plant", "kinematic", "--headless", "--json", "--duration", "0.1")
    result = q2r2(*options, "--rt")
    assert result.exit_code == 0
    assert [line for line in result.stderr.splitlines() if "real time" in line] == [refusal]
    assert one_object(result.stdout)["ticks"] == 101
    told = q2r2(*options).stderr
    assert "real time" not in told
    assert "dual_iiwa7: begins, 0.1 s, in simulated time; --web shows the arms in a browser\n" in told
    assert "dual_iiwa7: begins, 0.1 s, in simulated time\n" in q2r2(*options, "--fast").stderr


CAMERAS = ["above", "left_wrist", "right_wrist"]


@pytest.mark.parametrize(
    ("options", "display", "viser", "shown"),
    [
        pytest.param((), True, True, (True, None), id="display"),
        pytest.param((), False, True, (False, ("127.0.0.1", 0, None)), id="no display"),
        pytest.param((), False, False, (False, None), id="neither"),
        pytest.param(("--web-port", "18082"), False, True, (False, ("127.0.0.1", 18082, None)), id="a port is given"),
        pytest.param(("--web",), True, True, (False, ("127.0.0.1", 8080, None)), id="a page is asked for"),
    ],
)
def test_a_demo_at_a_terminal_shows_the_arms_in_a_window_or_on_a_page_if_one_of_them_is_possible(
    monkeypatch: pytest.MonkeyPatch,
    options: tuple[str, ...],
    display: bool,
    viser: bool,
    shown: tuple[bool, tuple[str, int, None] | None],
) -> None:
    def run_cell(config: Config, given: RunOptions) -> None:
        assert (given.window, given.page) == shown
        raise Exit(7)

    monkeypatch.setattr(f"{MODULE}._shows_table", lambda headless, viewer: True)
    monkeypatch.setattr("q2r2_control.plants.mujoco_cameras.window_fault", lambda: None if display else "no display")
    monkeypatch.setattr(f"{MODULE}.find_spec", lambda name: viser or None)
    monkeypatch.setattr(f"{MODULE}.run_cell", run_cell)
    result = q2r2("demo", *options)
    assert result.exit_code == 7
    assert (install_line("web") in result.stderr) is (not (display or viser))


def about_of(folder: Path) -> About:
    (file,) = folder.rglob("*.mcap")
    return Recording(file).about


@pytest.mark.slow
def test_the_seed_of_a_demo_displaces_only_the_parts_of_its_task(tmp_path: Path) -> None:
    shipped, places = load_config(CELL).mujoco.objects, []
    for seed in ("3", "4"):
        options = ("--spread", "0.03", "--seed", seed, "--fast", "--headless", "--duration", "0.05")
        q2r2("demo", "grasp", *options, "--record", str(tmp_path / seed))
        laid = parse_config(about_of(tmp_path / seed).cell, "recorded").mujoco.objects
        moved = {name: np.subtract(item.position, shipped[name].position) for name, item in laid.items()}
        assert [name for name, by in moved.items() if by.any()] == ["flat_block"]
        places.append(moved["flat_block"])
    assert np.abs(places).max() <= 0.03
    assert np.abs(np.subtract(*places)).max() > 0.01
    assert places[0][2] == places[1][2] == 0.0


@pytest.mark.parametrize("other", [("--plant", "fri"), ("--seeds", "1")])
def test_the_option_spread_is_refused_if_it_would_displace_no_part(other: tuple[str, str]) -> None:
    result = q2r2("demo", "grasp", "--spread", "0.01", *other)
    assert result.exit_code == 2
    assert "--spread cannot be used with --" in result.stderr


def test_an_anonymous_recording_names_neither_the_operator_nor_the_computer(tmp_path: Path) -> None:
    options = (*OPTIONS, "--operator", "Ada Lovelace", "--record")
    for name, more in (("named", ()), ("anonymous", ("--anonymous",))):
        assert q2r2("run", CELL, *options, str(tmp_path / name), *more).exit_code == 0
        told = b"".join(file.read_bytes() for file in (tmp_path / name).rglob("*") if file.suffix in (".mcap", ".yaml"))
        assert (b"Ada Lovelace" in told) is (name == "named")
        machine = about_of(tmp_path / name).notes["machine"]
        assert machine == platform.platform() if more else f"{platform.node()}, {platform.platform()}"


@pytest.mark.slow
def test_the_pictures_of_a_demo_become_videos_in_an_export(tmp_path: Path) -> None:
    needs_opengl()
    pytest.importorskip("av", reason="the extra export is not installed")
    options = ("--fast", "--json", "--headless", "--duration", "0.5", "--record", str(tmp_path / "recordings"))
    recording = one_object(q2r2("demo", "grasp", *options).stdout)["recording"]
    assert (recording["pictures_fault"], recording["lost_pictures"]) == (None, 0)
    file = Recording(Path(recording["file"]))
    counts = [len(list(file.pictures(name))) for name in CAMERAS]
    assert counts == [counts[0]] * 3
    assert sum(counts) == recording["pictures"] >= 3 * 8
    # The judge discards the episode, because the task takes longer than the run.
    output = ("--output", str(tmp_path / "grasp"), "--keep-discarded")
    exported = q2r2("export", "lerobot-v2.1", str(tmp_path / "recordings"), *output)
    assert exported.exit_code == 0, exported.stderr
    assert len(list((tmp_path / "grasp/videos").rglob("episode_000000.mp4"))) == 3


@pytest.mark.slow
def test_if_the_computer_cannot_draw_pictures_one_line_says_so_and_everything_else_is_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "nothing")
    options = ("--fast", "--json", "--headless", "--duration", "0.1", "--record", str(tmp_path))
    result = q2r2("run", CELL, *options)
    recording = one_object(result.stdout)["recording"]
    assert (result.exit_code, recording["fault"], recording["pictures"]) == (0, None, 0)
    assert "MUJOCO_GL" in recording["pictures_fault"]
    assert recording["ticks"] >= 100


@pytest.mark.slow
def test_if_the_plant_has_no_pictures_the_run_says_so_and_is_recorded_without_pictures(tmp_path: Path) -> None:
    result = q2r2("run", CELL, *OPTIONS, "--record", str(tmp_path / "recordings"))
    assert result.exit_code == 0
    assert "no pictures are recorded: the kinematic plant has none; allowed: --plant mujoco\n" in result.stderr
    assert Recording(Path(one_object(result.stdout)["recording"]["file"])).about.cameras == ()


@pytest.mark.parametrize(
    ("policy", "code", "told"),
    [
        ("json:dumps", 1, "actions of the policy that cannot be used: the policy raised TypeError"),
        ("sys:exit", 2, "the run was ended by SystemExit("),
    ],
    ids=["raises", "exits"],
)
def test_a_policy_that_fails_makes_the_run_fail(policy: str, code: int, told: str) -> None:
    result = q2r2("run", CELL, *OPTIONS, "--input", "policy", "--policy", policy)
    assert result.exit_code == code
    assert told in " ".join([result.stdout, result.stderr])


def test_the_option_policy_without_the_policy_input_is_refused_and_the_missing_option_is_named() -> None:
    result = q2r2("run", CELL, *OPTIONS, "--policy", "json:dumps")
    told = "--policy cannot be used with --input scripted, which is the cell's input; add --input policy\n"
    assert (result.exit_code, result.stderr) == (2, f"q2r2: {told}")


def test_simulated_time_is_refused_at_once_for_a_plant_that_keeps_real_time() -> None:
    result = q2r2("demo", "grasp", "--plant", "fri", "--fast", "--headless")
    told = "q2r2: --fast cannot be used with --plant fri, which keeps real time\n"
    assert (result.exit_code, result.stderr) == (2, told)


POLICY = """
class Still:
    rate = 20.0

    def __call__(self, observation):
        return observation.state.q
"""


@pytest.mark.slow
def test_a_policy_in_the_working_folder_runs_but_is_refused_together_with_another_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "still_policy.py").write_text(POLICY)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    policy = ("--policy", "still_policy:Still")
    options = ("run", FAST[1], "--plant", "kinematic", "--fast", "--headless", "--duration", "0.3")
    result = q2r2(*options, "--input", "policy", *policy, "--json")
    assert result.exit_code == 0, result.stderr
    assert one_object(result.stdout)["arms"]["left"]["policy_s"] == pytest.approx(0.3, abs=0.01)
    assert "0 interventions" in q2r2(*options, "--input", "policy", *policy).stdout
    assert "--policy cannot be used with --input scripted" in q2r2(*options, "--input", "scripted", *policy).stderr
    assert "--policy MODULE:NAME is missing" in q2r2(*options, "--input", "policy").stderr
