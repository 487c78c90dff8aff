"""Read reports through the real hidapi, from a pseudo-terminal instead of /dev/hidraw, and print what the hand does.

No computer that runs the tests has a SpaceMouse, and its kernel cannot simulate one. Of hidapi, only the list of
devices is replaced.
"""

from __future__ import annotations

import os
import pty
import time
import tty
from collections.abc import Callable
from functools import partial

import hidraw
from q2r2_devices import reading
from q2r2_devices.spacemouse import MouseSettings, SpaceMouseInput, SpaceMouseSettings

from q2r2_control import HandSample
from tests.devices.mice import FULL, Mouse, both, buttons, translation, until


class Terminal:
    """A terminal that hidapi lists as a SpaceMouse."""

    def __init__(self) -> None:
        self.master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        hidraw.enumerate = lambda: [Mouse(self.path).info]

    def send(self, report: bytes) -> None:
        os.write(self.master, report)

    def unplug(self) -> None:
        os.close(self._slave)
        os.close(self.master)


def wait_for(
    source: SpaceMouseInput, fits: Callable[[HandSample], bool], act: Callable[[], None] = lambda: None
) -> None:
    """Poll until ``fits`` is True for a sample. Call ``act`` before each poll."""
    while True:
        act()
        # A terminal does not separate reports, so the reader has to take each report before the next one is sent.
        time.sleep(0.02)
        if any(map(fits, source.poll(time.monotonic()))):
            return


def engage(source: SpaceMouseInput, terminal: Terminal) -> None:
    terminal.send(buttons(left=True))
    wait_for(source, lambda sample: sample.inputs.button_lower)
    terminal.send(buttons())
    wait_for(source, lambda sample: not sample.inputs.button_lower)
    print("engages")


def main() -> None:
    reading._RETRY = 0.01
    terminal = Terminal()
    source = SpaceMouseInput(SpaceMouseSettings(right=MouseSettings()))
    source.start()
    engage(source, terminal)
    wait_for(source, lambda sample: sample.position[0] > 0.02, partial(terminal.send, translation(back=-FULL)))
    wait_for(source, lambda sample: sample.position[0] > 0.04, partial(terminal.send, both(0, -FULL, 0, 0, 0, 0)))
    print("forwards")
    terminal.unplug()
    until(lambda: not source.connected)
    assert not source.poll(time.monotonic())
    print("lost")
    terminal = Terminal()
    until(lambda: source.connected)
    engage(source, terminal)
    source.close()


if __name__ == "__main__":
    main()
