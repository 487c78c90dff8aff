"""Commands that serve a headset: what they print about the headset, and how they end."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.cli.command import CELL, one_object, q2r2
from tests.support.fake_headset import FakeHeadset


@contextmanager
def process(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-c", "from q2r2_control.cli.app import app; app()", *arguments]
    running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        yield running
    finally:
        running.kill()
        running.communicate()


def bound_port(running: subprocess.Popen[str]) -> int:
    """Return the port that the documented line on stderr names."""
    assert running.stderr is not None
    for line in running.stderr:
        if line.startswith("headset: listening on "):
            return int(line.rsplit(":", 1)[1])
    return pytest.fail("the command ended without naming its address")


def fake_headset(port: int, duration: float) -> None:
    """Run a fake headset in its own process. It engages both arms, and its hands move in circles."""
    arguments = ["--port", str(port), "--duration", str(duration)]
    subprocess.run([sys.executable, "-m", "tests.support.fake_headset", *arguments], check=True, timeout=30)


@pytest.mark.slow
def test_headset_check_reports_the_messages_of_a_headset_in_another_process() -> None:
    with process("headset-check", "--port", "0", "--json") as running:
        fake_headset(bound_port(running), 1.5)
        running.send_signal(signal.SIGINT)
        stdout, _ = running.communicate(timeout=30)
    assert running.returncode == 0
    check = one_object(stdout)
    assert (check["dialect"], check["connections"]) == ("ROS2", 1)
    assert check["last_disconnect"] == "closed by the headset"
    assert set(check["topics"]) == {
        f"q2r_{hand}_hand_{kind}" for hand in ("left", "right") for kind in ("pose", "inputs")
    }
    assert check["topics"]["q2r_left_hand_pose"]["count"] == 112


def test_a_headset_server_on_every_network_names_the_address_for_the_app_and_the_allowed_hosts() -> None:
    result = q2r2("headset-check", "--host", "0.0.0.0", "--port", "0", "--duration", "0.1", "--json")
    port = one_object(result.stdout)["address"][1]
    listening, enter, drivers = result.stderr.splitlines()[:3]
    assert listening == f"headset: listening on 0.0.0.0:{port}"
    assert re.fullmatch(rf"headset: enter in the app: address .+, port {port}, protocol ROS2", enter)
    assert drivers.startswith("headset: whoever reaches this port can drive the arms; headset.allow")


@pytest.mark.slow
def test_a_host_outside_the_networks_in_headset_allow_is_refused(tmp_path: Path) -> None:
    cell = tmp_path / "cell.yaml"
    cell.write_text(Path(CELL).read_text(encoding="utf-8").replace("allow: null", "allow: [10.0.0.0/8]"), "utf-8")
    with process("headset-check", str(cell), "--host", "0.0.0.0", "--port", "0", "--json") as running:
        with FakeHeadset(("127.0.0.1", bound_port(running))) as headset:
            assert b"127.0.0.1 is not in headset.allow" in headset.read_until("__error")
        running.send_signal(signal.SIGINT)
        assert running.stderr is not None
        stderr = running.stderr.read()  # These are all lines after the line with the address.
    assert "only 10.0.0.0/8 can drive the arms" in stderr


def test_headset_check_gives_advice_if_no_data_arrive() -> None:
    result = q2r2("headset-check", "--port", "0", "--duration", "2.3", "--json")
    assert result.exit_code == 1
    advice = "\n".join(one_object(result.stdout)["advice"])
    address = "{}:{}".format(*one_object(result.stdout)["address"])
    for expected in (address, "--host 0.0.0.0", "firewall", "network", "ROS2"):
        assert expected in advice
        assert expected in result.stderr


@pytest.mark.slow
def test_ctrl_c_brings_the_arms_to_rest_and_ends_a_headset_run_with_its_summary() -> None:
    arguments = ("--input", "headset", "--port", "0", "--plant", "kinematic", "--headless", "--json")
    with process("run", CELL, *arguments) as running:
        fake_headset(bound_port(running), 2.0)
        running.send_signal(signal.SIGINT)
        stdout, stderr = running.communicate(timeout=30)
    assert running.returncode == 0, stderr
    summary = one_object(stdout)
    assert summary["at_rest"]
    assert summary["arms"]["left"]["engaged_s"] > 0.0
    assert "connection_lost" in [event["kind"] for event in summary["events"]]
