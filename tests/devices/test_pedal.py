"""The pedal reads the kernel's event structures. In these tests, a named pipe replaces the event device."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest
from q2r2_devices.pedal import Pedal

from q2r2_control import InputError

KEY_B, KEY_C, SPACE = 48, 46, 57
DOWN, UP, REPEAT = 1, 0, 2


def events(*keys: tuple[int, int]) -> bytes:
    """Return what Linux writes when keys change: a scan code, the key, and the end of the report."""
    made = b""
    for code, value in keys:
        for kind, number, given in ((4, 4, 0x70005), (1, code, value), (0, 0, 0)):
            made += struct.pack("@llHHi", 1700000000, 123456, kind, number, given)
    return made


@pytest.fixture
def pedal(tmp_path: Path) -> Iterator[tuple[Pedal, int]]:
    os.mkfifo(path := tmp_path / "event-kbd")
    made = Pedal(str(path))
    made.open()
    writer = os.open(path, os.O_WRONLY)
    yield made, writer
    made.close()


def test_a_pedal_is_held_from_its_press_to_its_release(pedal: tuple[Pedal, int]) -> None:
    device, writer = pedal
    assert device.read() is None
    for keys, held in (
        ([(KEY_B, DOWN)], True),
        ([(KEY_B, REPEAT)], True),
        ([(KEY_B, UP)], False),
        ([(KEY_B, DOWN), (KEY_C, DOWN), (KEY_B, UP)], True),
        ([(KEY_C, UP)], False),
    ):
        os.write(writer, events(*keys))
        assert device.read() is held
    os.close(writer)


def test_a_pedal_whose_release_the_kernel_may_have_dropped_is_not_held_until_its_key_is_pressed_or_repeats(
    pedal: tuple[Pedal, int],
) -> None:
    device, writer = pedal
    os.write(writer, events((KEY_B, DOWN)))
    assert device.read() is True
    os.write(writer, struct.pack("@llHHi", 1700000000, 123456, 0, 3, 0))  # EV_SYN, SYN_DROPPED
    assert device.read() is False
    os.write(writer, events((KEY_B, REPEAT)))
    assert device.read() is True


def test_reading_a_pedal_that_was_removed_raises_an_error(pedal: tuple[Pedal, int]) -> None:
    device, writer = pedal
    os.write(writer, events((KEY_B, DOWN)))
    os.close(writer)
    assert device.read() is True
    with pytest.raises(EOFError, match="event-kbd has ended"):
        device.read()


def test_the_error_for_a_pedal_without_permission_names_the_group_that_may_read_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: object) -> int:
        raise PermissionError

    # If root runs the test, no file lacks permission. The refusal is therefore simulated.
    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(InputError, match=r"^no permission to read /dev/input/event7; sudo usermod -aG input"):
        Pedal("/dev/input/event7").open()
