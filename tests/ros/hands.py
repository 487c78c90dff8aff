"""Both hands of an operator, which do the same at the same time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin

from tests.ros.arm_rig import ArmRig
from tests.ros.processes import PATIENCE


class Hands:
    """Moves the hands of some rigs together."""

    def __init__(self, rigs: list[ArmRig]) -> None:
        self.rigs = rigs

    def wait(self, condition: Callable[[ArmRig], Any], what: str, timeout: float = PATIENCE) -> None:
        """Until ``condition`` holds for all."""
        for rig in self.rigs:
            rig.wait(partial(condition, rig), f"{rig.arm}: {what}", timeout)

    def engage(self) -> None:
        """Press until all follow; what was sent before does not count."""
        self.wait(lambda rig: rig.state.get("level") == "ok", "nothing keeps the arm from being engaged")
        self._press_until(lambda rig: rig.state.get("engaged"), "the arm is engaged")

    def pause(self) -> None:
        """Press until all are paused."""
        self._press_until(lambda rig: rig.state.get("state") == "paused", "the arm is paused")

    def wait_for_pause(self) -> None:
        self.wait(lambda rig: rig.state.get("state") == "paused", "the arm is paused")

    def move(self, by: tuple[float, float, float], duration: float, turn: float = 0.0) -> None:
        """See :meth:`ArmRig.move`."""
        threads = [threading.Thread(target=rig.move, args=(by, duration, turn)) for rig in self.rigs]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    def fall_silent(self) -> None:
        """No more data of any hand, until all are paused; then they speak again from elsewhere."""
        for rig in self.rigs:
            rig.sends_hand = False
        self.wait_for_pause()
        for rig in self.rigs:
            rig.hand = pin.SE3(rig.hand.rotation, rig.hand.translation + np.array([0.4, -0.4, 0.4]))
            rig.sends_hand = True

    def _press_until(self, condition: Callable[[ArmRig], Any], what: str) -> None:
        """A busy machine loses a press now and then: hands press again where nothing has come of it for long."""
        deadline = time.monotonic() + PATIENCE
        while rigs := [rig for rig in self.rigs if not condition(rig)]:
            assert time.monotonic() < deadline, f"{rigs[0].arm}: waited until {what}; state {rigs[0].state}"
            for rig in rigs:
                rig.lower = True
            time.sleep(0.15)
            for rig in rigs:
                rig.lower = False
            patience = time.monotonic() + 3.0
            while not all(map(condition, rigs)) and time.monotonic() < patience:
                time.sleep(0.01)
