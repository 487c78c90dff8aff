"""A gripper on Modbus, tested with a simulated gripper that moves by one step whenever it is read."""

from __future__ import annotations

import os
import re
import select
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from pymodbus.framer import FramerType

from q2r2_control.config.fri import ModbusGripperConfig
from q2r2_control.errors import ConfigError
from q2r2_control.extras import install_line
from q2r2_control.plants.modbus_gripper import ModbusGripper
from tests.support.headset_server import eventually, warnings
from tests.support.robotiq_gripper import SimulatedGripper

ACTIVATE, RESET = (1, 0, 0, 0, 0, 0), (0, 0, 0, 0, 0, 0)
MODULE = "q2r2_control.plants.modbus_gripper"
Connect = Callable[..., ModbusGripper]


@pytest.fixture
def simulated() -> Iterator[SimulatedGripper]:
    with SimulatedGripper() as made:
        yield made


@pytest.fixture
def connect(simulated: SimulatedGripper, monkeypatch: pytest.MonkeyPatch) -> Iterator[Connect]:
    """Return a gripper under test that does not lose its connection on a busy machine."""
    monkeypatch.setattr(f"{MODULE}._TIMEOUT", 30.0)
    monkeypatch.setattr(f"{MODULE}._AGAIN", 0.01)
    started: list[ModbusGripper] = []

    def start(**settings: Any) -> ModbusGripper:
        config = ModbusGripperConfig(**{"modbus": f"127.0.0.1:{simulated.port}", **settings})
        started.append(ModbusGripper("left", config))
        started[-1].start()
        return started[-1]

    yield start
    # The timeout for an answer is 30 s here. A lost connection ends the wait for an answer at once.
    simulated.stop()
    for gripper in started:
        gripper.close()


def read_on(simulated: SimulatedGripper, times: int = 10) -> None:
    """Wait until the gripper was read several more times."""
    enough = simulated.reads + times
    eventually(lambda: simulated.reads >= enough, "the gripper is read")


def measures(gripper: ModbusGripper, opening: float) -> None:
    eventually(lambda: gripper.opening == pytest.approx(opening, abs=0.003), f"opening {opening}")


def test_the_gripper_is_only_read_before_the_first_command(connect: Connect, simulated: SimulatedGripper) -> None:
    gripper = connect()
    read_on(simulated)
    assert simulated.written == []
    assert gripper.opening is None
    assert (
        gripper.in_words() == f"127.0.0.1:{simulated.port}, unit 9: not active until a run begins, position 120 of 255"
    )


def test_the_first_command_activates_the_gripper_which_then_moves_to_the_newest_opening(
    connect: Connect, simulated: SimulatedGripper, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    gripper = connect(speed=0.2, force=1.0)
    gripper.command(0.4)
    measures(gripper, 0.4)
    gripper.command(0.8)
    measures(gripper, 0.8)
    assert simulated.written == [ACTIVATE, (9, 0, 0, 153, 51, 255), (9, 0, 0, 51, 51, 255)]
    assert "left gripper: is activated, its fingers open and close" in caplog.messages


def test_an_active_gripper_is_not_activated_again_so_that_it_keeps_its_object(
    connect: Connect, simulated: SimulatedGripper
) -> None:
    simulated.activate()
    gripper = connect()
    measures(gripper, 1 - 120 / 255)
    gripper.command(1.0)
    measures(gripper, 1.0)
    assert simulated.written == [(9, 0, 0, 0, 255, 128)]


def test_a_gripper_that_loses_power_during_activation_is_activated_again(
    connect: Connect, simulated: SimulatedGripper
) -> None:
    simulated.activation = 10**9
    gripper = connect()
    gripper.command(0.4)
    eventually(lambda: simulated.written == [ACTIVATE])
    simulated.stop()
    simulated.activation = 3
    simulated.power_off()
    simulated.start()
    measures(gripper, 0.4)
    assert simulated.activations == 1


@pytest.mark.parametrize(
    ("fault", "begins"),
    [
        pytest.param(0x0E, [RESET, ACTIVATE], id="overcurrent"),
        pytest.param(0x09, [], id="nobody has spoken to it for a second"),
    ],
)
def test_a_gripper_is_reset_at_the_first_command_if_only_a_reset_ends_its_fault(
    connect: Connect, simulated: SimulatedGripper, fault: int, begins: list[tuple[int, ...]]
) -> None:
    simulated.activate()
    simulated.fault = fault
    gripper = connect()
    read_on(simulated)
    if begins:
        assert gripper.opening is None, "its fingers open and close before their opening counts"
    else:
        measures(gripper, 1 - 120 / 255)
    gripper.command(0.0)
    measures(gripper, 0.0)
    assert simulated.written == [*begins, (9, 0, 0, 255, 255, 128)]


def test_if_an_object_stops_the_fingers_their_opening_at_the_object_is_measured(
    connect: Connect, simulated: SimulatedGripper
) -> None:
    simulated.object_at = 204
    gripper = connect()
    gripper.command(0.0)
    eventually(lambda: gripper.status and gripper.status.holds, "it holds the object")
    measures(gripper, 0.2)
    assert gripper.in_words().endswith("unit 9: active, position 204 of 255, holds something")


def test_the_setting_counts_gives_the_open_and_closed_positions_and_measured_openings_are_clipped(
    connect: Connect, simulated: SimulatedGripper
) -> None:
    simulated.activate()
    gripper = connect(counts=(3, 230))
    for opening, position in ((0.5, 116), (0.0, 255), (1.0, 0)):
        gripper.command(opening)
        measures(gripper, opening)
        read_on(simulated)
        assert simulated.position == position


def test_a_lost_connection_is_reported_once_and_the_newest_opening_is_sent_after_its_return(
    connect: Connect, simulated: SimulatedGripper, caplog: pytest.LogCaptureFixture
) -> None:
    gripper = connect()
    gripper.command(0.0)
    measures(gripper, 0.0)
    simulated.stop()
    with socket.create_server(("127.0.0.1", simulated.port)) as drops:
        for _ in range(5):
            drops.accept()[0].close()
        assert gripper.opening is None
        assert gripper.in_words().endswith("unit 9: does not answer")
        gripper.command(0.6)
    simulated.written.clear()
    simulated.start()
    measures(gripper, 0.6)
    assert simulated.written == [(9, 0, 0, 102, 255, 128)]
    lost = f"does not answer at 127.0.0.1:{simulated.port}, unit 9, and is asked again every 0.01 s"
    assert warnings(caplog) == [f"left gripper: {lost}"]


def test_an_opening_becomes_unknown_before_the_gripper_counts_as_lost(
    connect: Connect, simulated: SimulatedGripper, caplog: pytest.LogCaptureFixture
) -> None:
    gripper = connect()
    gripper.command(0.5)
    measures(gripper, 0.5)
    simulated.silent = True
    eventually(lambda: gripper.opening is None)
    assert gripper.status is not None
    assert warnings(caplog) == []


def test_a_gripper_that_was_switched_off_during_a_run_is_activated_only_in_the_next_run(
    connect: Connect, simulated: SimulatedGripper, caplog: pytest.LogCaptureFixture
) -> None:
    gripper = connect()
    gripper.command(0.5)
    measures(gripper, 0.5)
    simulated.power_off()
    # On a busy machine the opening may be unknown before the loss of power is read, because its measurement is too old.
    eventually(lambda: gripper.status is not None and not gripper.status.activated)
    gripper.command(0.0)
    read_on(simulated)
    assert simulated.written == []
    assert warnings(caplog) == ["left gripper: is not active any more; the next run activates it"]


def test_a_fault_during_a_run_is_reported_once_in_words(
    connect: Connect, simulated: SimulatedGripper, caplog: pytest.LogCaptureFixture
) -> None:
    gripper = connect()
    gripper.command(0.5)
    measures(gripper, 0.5)
    simulated.fault = 0x0E
    read_on(simulated)
    measures(gripper, 0.5)
    assert simulated.activations == 1
    assert warnings(caplog) == ["left gripper: fault 0x0e, overcurrent; the next run activates it"]


@contextmanager
def serial_line(port: int) -> Iterator[str]:
    """Return the path of a serial device whose other end is connected to a TCP port."""
    end, device = os.openpty()
    done = threading.Event()

    def carry(line: int) -> None:
        while not done.is_set():
            for source in select.select([end, line], [], [], 0.02)[0]:
                os.write(end if source == line else line, os.read(source, 1000))

    with socket.create_connection(("127.0.0.1", port)) as line:
        thread = threading.Thread(target=carry, args=(line.fileno(),))
        thread.start()
        yield os.ttyname(device)
        done.set()
        thread.join()
    os.close(end)
    os.close(device)


def test_a_gripper_on_a_serial_device_speaks_modbus_rtu() -> None:
    with SimulatedGripper(FramerType.RTU) as simulated, serial_line(simulated.port) as device:
        gripper = ModbusGripper("left", ModbusGripperConfig(modbus=device))
        gripper.start()
        gripper.command(0.2)
        measures(gripper, 0.2)
        gripper.close()
        assert simulated.activations == 1


def test_a_missing_pymodbus_is_an_error_that_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pymodbus.client", None)
    with pytest.raises(ConfigError, match=rf"fri\.left\.gripper\.modbus: .* {re.escape(install_line('modbus'))}"):
        ModbusGripper("left", ModbusGripperConfig(modbus="192.168.1.11"))
