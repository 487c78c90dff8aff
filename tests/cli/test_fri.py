"""``q2r2 fri-cabinet``, which simulates the cabinets of a cell."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from q2r2_control.cli.fri import Pendant, rehearsal, wait_for_states
from q2r2_control.config.cell_file import load_config
from q2r2_control.errors import PlantError
from q2r2_control.plants.fri.cabinet import Cabinet, CabinetSettings, StillArm, Trip
from q2r2_control.plants.fri.plant import FriPlant
from q2r2_control.plants.fri.wire import LONGEST, Safety, Session, read_monitoring
from q2r2_control.robot.robot import Robot
from q2r2_control.types import CommandMode
from tests.cli.command import q2r2

CELL = "config/dual_iiwa7_fri.yaml"


def test_without_a_client_the_cabinets_wait(fri_cell: str) -> None:
    done = q2r2("fri-cabinet", fri_cell, "--duration", "0.3", "--json")
    assert done.exit_code == 0
    waiting = {"state": "monitoring wait", "missed": 0, "trips": []}
    assert json.loads(done.stdout)["cabinets"] == {"left": waiting, "right": waiting}
    assert "left: monitoring wait" in done.stderr


def test_a_safety_stop_ends_a_session_and_lasts_a_second() -> None:
    ones = (1.0,) * 7
    settings = CabinetSettings(ones, ones, ones, ones, ones)
    cabinets = {arm: Cabinet(settings, StillArm((0.0,) * 7)) for arm in ("left", "right")}
    pendant = Pendant(cabinets, 0.5, None, 3.0, Console(quiet=True))
    for cabinet in cabinets.values():
        cabinet.session = Session.COMMANDING_ACTIVE
    seen = []
    for now in (1.0, 3.9, 4.0, 4.9, 5.1):
        pendant.look(now)
        seen.append(cabinets["left"].safety)
    assert seen == [Safety.NORMAL] * 2 + [Safety.STOP_1_ON_PATH] * 2 + [Safety.NORMAL]
    assert (cabinets["left"].trips, cabinets["right"].trips) == ([Trip.SAFETY], [])


@pytest.mark.slow
def test_a_press_of_enter_stops_all_overlays_and_the_next_press_starts_them_again(fri_cell: str) -> None:
    ours, theirs = os.openpty()
    # The first terminal that a new session opens becomes its controlling terminal.
    opening = f"import os; os.dup2(os.open({os.ttyname(theirs)!r}, os.O_RDWR), 0)"
    code = f"{opening}; from q2r2_control.cli.app import app; app()"
    command = (sys.executable, "-c", code, "fri-cabinet", fri_cell, "--json")
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, start_new_session=True) as process:
        assert process.stderr is not None
        said = iter(process.stderr.readline, "")
        try:
            assert any("right: monitoring wait" in line for line in said)
            for told in ("overlays are stopped, Enter starts them\n", "overlays start\n"):
                os.write(ours, b"\n")
                assert next(said) == told
        finally:
            process.terminate()
    os.close(ours)
    os.close(theirs)


def test_if_the_pendant_stops_the_overlays_they_start_again_only_after_its_next_key_press() -> None:
    ones = (1.0,) * 7
    settings = CabinetSettings(ones, ones, ones, ones, ones)
    cabinets = {arm: Cabinet(settings, StillArm((0.0,) * 7)) for arm in ("left", "right")}
    pendant = Pendant(cabinets, 0.5, None, None, Console(quiet=True))
    for cabinet in cabinets.values():
        cabinet.session = Session.COMMANDING_ACTIVE
    pendant.toggle()
    pendant.look(1.0)
    pendant.look(9.0)
    assert [(cabinet.trips, cabinet._overlay) for cabinet in cabinets.values()] == [([Trip.STOPPED], False)] * 2
    pendant.toggle()
    pendant.look(10.0)
    assert all(cabinet._overlay for cabinet in cabinets.values())


def test_each_message_of_a_cabinet_says_how_many_messages_come_per_answer(fri_cell: str) -> None:
    port = load_config(fri_cell).fri["left"].port
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.bind(("127.0.0.1", port))
        client.settimeout(30.0)
        assert q2r2("fri-cabinet", fri_cell, "--multiplier", "3", "--duration", "0.1").exit_code == 0
        assert read_monitoring(client.recv(LONGEST)).multiplier == 3


@pytest.mark.parametrize("arguments", [(), ("--source-port", "0")], ids=["client's port", "any port"])
def test_a_cabinet_sends_from_its_own_address_and_from_the_same_port_number_as_its_client_unless_an_option_is_given(
    fri_cell: str, arguments: tuple[str, ...]
) -> None:
    port = load_config(fri_cell).fri["left"].port
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.bind(("127.0.0.1", port))
        client.settimeout(30.0)
        assert q2r2("fri-cabinet", fri_cell, "--duration", "0.1", *arguments).exit_code == 0
        address, source = client.recvfrom(LONGEST)[1]
    assert address == "127.0.0.2"
    assert (source == port) is (not arguments)


def test_a_rehearsal_begins_when_all_cabinets_send(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "lines"
    file.touch()
    looks = iter(("0.000 s  left: monitoring wait\n", "a line\n", "0.004 s  right: monitoring wait\n"))

    def sleep(_: float) -> None:
        with file.open("a", encoding="utf-8") as lines:
            lines.write(next(looks))

    monkeypatch.setattr("q2r2_control.cli.fri.time.sleep", sleep)
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE, text=True) as child:
        with file.open("rb") as lines:
            wait_for_states(child, lines.fileno(), 2)
        child.communicate("\n")
    assert next(looks, None) is None


@pytest.mark.slow
def test_a_rehearsal_whose_cabinets_cannot_begin_raises_an_error_with_the_reason(fri_cell: str) -> None:
    port = load_config(fri_cell).fri["left"].port
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.2", port))
        with (
            pytest.raises(PlantError, match=f"stand in have ended: q2r2: the left cabinet cannot send from .*{port}"),
            rehearsal(fri_cell, CommandMode.POSITION, (), 10.0, False),
        ):
            pass


@pytest.mark.slow
def test_a_run_says_that_it_waits_for_a_cabinet_and_ctrl_c_ends_the_wait(fri_cell: str) -> None:
    words = ("run", fri_cell, "--input", "scripted", "--trajectory", "circle", "--wait", "600")
    command = (sys.executable, "-m", "q2r2_control", *words)
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        said = iter(process.stderr.readline, "")
        try:
            assert any(line.startswith("waits: left: no FRI message from cabinet 127.0.0.2 on port") for line in said)
        finally:
            process.send_signal(signal.SIGINT)
        *_, last = said
    assert process.returncode == 2
    assert last.startswith("q2r2: left: no FRI message from")
    assert "the wait was stopped after" in last
    plant = FriPlant.from_config(Robot.from_config(config := load_config(fri_cell)), config)
    assert plant.is_released(), "nothing keeps the ports"


def test_fri_cabinet_prints_one_line_if_another_program_uses_the_port_of_a_cabinet(fri_cell: str) -> None:
    port = load_config(fri_cell).fri["right"].port
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.3", port))
        done = q2r2("fri-cabinet", fri_cell, "--duration", "0.1")
    assert (done.exit_code, done.stderr.count("\n")) == (2, 1)
    assert f"the right cabinet cannot send from 127.0.0.3, port {port}: Address already in use" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("config/dual_iiwa7.yaml",), "fri.left: missing; allowed: the cabinet of each arm"),
        ((CELL, "--mode", "velocity"), "--mode velocity: allowed: position, torque"),
        ((CELL, "--duration", "-1"), "--duration"),
        ((CELL, "--mode", "torque"), "answered every 10 ms: allowed with torques: 5 ms or less"),
    ],
)
def test_fri_cabinet_prints_one_line_about_a_wrong_option(arguments: tuple[str, ...], told: str) -> None:
    done = q2r2("fri-cabinet", *arguments)
    assert (done.exit_code, done.stderr.count("\n")) == (2, 1)
    assert told in done.stderr


def test_check_names_a_wrong_setting_of_a_cabinet(tmp_path: Path) -> None:
    text = Path(CELL).read_text(encoding="utf-8")
    for wrong, told in (("address: 127.0.0.2", "address: here"), ("version: null", "version: 3")):
        file = tmp_path / "cell.yaml"
        file.write_text(text.replace(wrong, told), encoding="utf-8")
        done = q2r2("check", str(file))
        assert done.exit_code == 2
        assert "fri.left." in done.stderr


def test_a_demo_on_the_kinematic_plant_is_refused() -> None:
    done = q2r2("demo", "--plant", "kinematic")
    assert done.exit_code == 2
    assert "--plant 'kinematic': allowed: mujoco, fri" in done.stderr


def test_the_option_wait_is_refused_for_a_simulated_plant() -> None:
    done = q2r2("run", "config/dual_iiwa7.yaml", "--input", "scripted", "--wait", "5")
    assert done.exit_code == 2
    assert "--wait cannot be used with --plant mujoco" in done.stderr
