"""The left arm's node, which stands still at SIGUSR1 in the middle of a tick, after it has computed its target."""

from __future__ import annotations

import signal
import sys
import time
from typing import Any

from q2r2_control.ros.base_node import run_node
from q2r2_control.ros.nodes.arm_controllers import LeftArmController

STALL = 3.0  # The stall is longer than the timeouts of the tests' arm rig [s].


class StallingArm(LeftArmController):
    def setup_interfaces(self) -> None:
        super().setup_interfaces()
        outputs: Any = self.outputs
        stalls: list[float] = []
        step = outputs.step
        signal.signal(signal.SIGUSR1, lambda *_: stalls.append(STALL))

        def late(*values: Any) -> Any:
            time.sleep(stalls.pop() if stalls else 0.0)
            return step(*values)

        outputs.step = late


if __name__ == "__main__":
    sys.exit(run_node(StallingArm))
