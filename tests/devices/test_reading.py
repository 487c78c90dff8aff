"""The thread of a device goes on after a few failed reads, and can be started again after it was closed.

A device that never answers counts as lost. It delays neither the loop nor the end of the program.
"""

from __future__ import annotations

from threading import Event

import pytest
from q2r2_devices import reading
from q2r2_devices.reading import DeviceInput, DeviceReader

from q2r2_control import InputError
from tests.devices.mice import until


class Flaky:
    """A device whose reads fail, except for every fifth one. It counts its reads."""

    def __init__(self) -> None:
        self.reads = 0

    def open(self) -> str:
        return "a flaky device"

    def read(self) -> int:
        self.reads += 1
        if self.reads % 5:
            raise OSError("no answer")
        return self.reads

    def close(self) -> None:
        raise OSError("not open")


def test_a_device_is_not_lost_after_four_failed_reads_in_a_row_and_a_closed_reader_can_start_again() -> None:
    device, lines = Flaky(), list[str]()
    reader = DeviceReader("left", device, lines.append)
    connected: list[bool] = []
    for start in (1, 2):
        reader.start()
        until(lambda least=device.reads + 50: device.reads > least)  # type: ignore[misc]
        connected.append(reader.connected)
        reader.close()
        connected.append(reader.connected)
        assert lines == ["left: a flaky device is connected"] * start
    assert connected == [True, False, True, False]
    assert reader.take()[-1] is None


class Silent:
    """A device that answers once, and then waits in its second read until ``answers`` is set."""

    def __init__(self) -> None:
        self.answers = Event()
        self.reads = 0

    def open(self) -> str:
        return "a silent device"

    def read(self) -> int:
        self.reads += 1
        if self.reads > 1:
            self.answers.wait()
        return self.reads

    def close(self) -> None: ...


def test_a_device_that_does_not_answer_is_lost_and_counts_again_when_it_answers() -> None:
    device, lines = Silent(), list[str]()
    reader = DeviceReader("left", device, lines.append)
    reader.start()
    until(lambda: reader.take()[-1:] == [1] and reader.connected)
    until(lambda: reader.take() == [None])
    assert not reader.connected
    assert lines[1:] == ["left: lost, no answer for 1 s; it counts again as soon as it answers"]
    device.answers.set()
    until(lambda: (reader.take(), reader.connected)[1])
    assert lines[2:] == ["left: answers again"]
    reader.close()


def test_a_device_that_does_not_answer_delays_no_end_of_a_run_and_is_not_started_a_second_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(reading, "_LONGEST_CLOSE", 0.01)
    device, lines = Silent(), list[str]()
    source = DeviceInput({"left": DeviceReader("left", device, lines.append)})
    source.start()
    until(lambda: device.reads == 2)
    source.close()
    source.close()
    assert lines[1:] == ["left: does not answer, so it could not be closed"]
    with pytest.raises(InputError, match=r"^left: the device has not answered since the last run; allowed: after"):
        source.start()
    device.answers.set()
    until(lambda: not source.connected)


def test_if_the_start_of_a_device_is_interrupted_all_other_devices_are_closed() -> None:
    first = DeviceReader("left", Flaky(), lambda line: None)

    class Interrupted(DeviceReader[int]):
        def start(self) -> None:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        DeviceInput({"left": first, "right": Interrupted("right", Flaky())}).start()
    assert not first.connected
