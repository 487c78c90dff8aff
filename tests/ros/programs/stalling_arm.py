"""The left arm's node, which at SIGUSR1 stands still for a while in the middle of a tick, its target decided on."""

from __future__ import annotations

import signal
import sys
import time
from typing import Any

from q2r2_control.ros.base_node import run_node
from q2r2_control.ros.nodes.arm_controllers import LeftArmController

STALL = 3.0  # more than the timeouts of the tests' arm rig [s]


class StallingArm(LeftArmController):
    """Its outputs are reached late, once for each signal."""

    def setup_interfaces(self) -> None:
        super().setup_interfaces()
        self._stalls = False
        signal.signal(signal.SIGUSR1, self._on_signal)
        outputs: Any = self.outputs
        step = outputs.step

        def late(*values: Any) -> Any:
            if self._stalls:
                self._stalls = False
                time.sleep(STALL)
            return step(*values)

        outputs.step = late

    def _on_signal(self, *_: Any) -> None:
        self._stalls = True


if __name__ == "__main__":
    sys.exit(run_node(StallingArm))
