"""The thread of a device goes on after a few failed reads, and can be started again after it was closed."""

from __future__ import annotations

from q2r2_devices.reading import DeviceReader

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
