"""The doctor says what this computer lacks, what cures it, and whether a cell can be run."""

from __future__ import annotations

import socket
from importlib.metadata import metadata
from pathlib import Path

import pytest

from q2r2_control.cli import doctor
from q2r2_control.process.machine_notes import fair_server_notes
from tests.cli.command import changed_cell, one_object, q2r2


@pytest.fixture
def free_cell(tmp_path: Path) -> str:
    """Return the shipped cell with a free port."""
    return changed_cell(tmp_path, "port: 10000 ", "port: 0 ")


def test_if_nothing_is_missing_the_doctor_says_so_and_exits_with_0(free_cell: str) -> None:
    result = q2r2("doctor", free_cell, "--json")
    found = one_object(result.stdout)
    assert (result.exit_code, found["lacks"]) == (0, False)
    assert not any(finding["stops_arms"] for finding in found["findings"])
    assert "can be reached from this machine only" in found["headset"]
    assert all(finding["what"] and finding["cure"] for finding in found["findings"])


def test_a_port_that_another_program_uses_is_a_fault_with_a_cure(free_cell: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        file = Path(free_cell)
        file.write_text(file.read_text().replace("port: 0 ", f"port: {port} "))
        result = q2r2("doctor", free_cell)
    assert result.exit_code == 1
    assert f"missing     headset: port {port} of 127.0.0.1 cannot be listened on" in result.stdout
    assert "cure: another headset.port in the YAML" in result.stdout


def test_a_missing_or_too_old_package_is_named_with_the_pip_command_that_installs_it() -> None:
    wanted = ["numpy>=999", "no-such-package-of-ours>=1", "scipy>=1", "no-such-extra>=1; extra == 'dev'"]
    found = list(doctor._packages(wanted))
    assert [finding.what.partition(":")[0] for finding in found] == ["numpy", "no-such-package-of-ours"]
    assert all(finding.stops_arms for finding in found)
    assert found[0].cure.endswith("-m pip install 'numpy>=999'")


def test_a_missing_extra_is_named_with_the_commands_that_need_it() -> None:
    wanted = ["numpy>=999", "no-such-viewer>=1; extra == 'web'", "scipy>=1; extra == 'gym'"]
    (finding,) = doctor._extras(wanted)
    assert finding.what == "without no-such-viewer: no --web, no --input webxr"
    assert "[web]'" in finding.cure
    assert not finding.stops_arms


def test_every_extra_that_the_doctor_names_exists_in_the_package() -> None:
    extras = metadata("q2r2_control").get_all("Provides-Extra") or []
    assert set(doctor._NEEDS_EXTRA) <= set(extras)


def test_without_a_display_only_the_window_is_missing() -> None:
    (finding,) = doctor._display({})
    assert not finding.stops_arms
    assert list(doctor._display({"DISPLAY": ":0"})) == []


def test_a_note_about_the_kernel_is_split_into_fault_and_cure(
    free_cell: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    notes = ["real time: no SCHED_FIFO; the run goes on; give rtprio 40", *fair_server_notes("6.12.0", tmp_path)]
    monkeypatch.setattr(doctor, "machine_notes", lambda: notes)
    lines = q2r2("doctor", free_cell).stdout.splitlines()
    at = lines.index("warning     real time: no SCHED_FIFO; the run goes on")
    assert lines[at + 1].strip() == "cure: give rtprio 40"
    assert lines[at + 2].endswith("less than 5 % of a processor in a second")
    assert lines[at + 3].strip().startswith("cure: leave a processor free, or, as root")


def test_the_doctor_names_the_command_that_measures_the_jitter_of_cabinets(fri_cell: str) -> None:
    assert f"cabinets    q2r2 fri-check {fri_cell} says how evenly they send" in q2r2("doctor", fri_cell).stdout
