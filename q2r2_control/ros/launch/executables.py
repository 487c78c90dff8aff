"""The executables of the nodes. One that is still importing ends on Ctrl-C at once and without a traceback.

Imports take seconds, and what they run in C turns Ctrl-C into errors of many kinds. There is nothing to clean up yet,
so the system's own answer to the signal is the right one, until :func:`run_node` takes it over.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from importlib import import_module

MODULES = {
    "tcp_endpoint": "tcp_endpoint",
    "SimulationInput": "simulation_input",
    "hand_input": "hand_input",
    "CheckTCPconnection": "check_tcp_connection",
    "cartesian_controller": "cartesian_controller",
    "mujoco_robot": "mujoco_robot",
    "recorder": "recorder",
    "left_arm_controller": "left_arm_controller",
    "right_arm_controller": "right_arm_controller",
    "arm_controllers": "arm_controllers",
}


def _executable(name: str) -> Callable[[], int]:
    def run() -> int:
        sys.argv[0] = name
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        # q2r2 ros up blocks it, so that the interpreter's own start is not interrupted either.
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        code: int = import_module(f"q2r2_control.ros.nodes.{MODULES[name]}").main()
        return code

    return run


tcp_endpoint = _executable("tcp_endpoint")
simulation_input = _executable("SimulationInput")
hand_input = _executable("hand_input")
check_tcp_connection = _executable("CheckTCPconnection")
cartesian_controller = _executable("cartesian_controller")
mujoco_robot = _executable("mujoco_robot")
recorder = _executable("recorder")
left_arm_controller = _executable("left_arm_controller")
right_arm_controller = _executable("right_arm_controller")
arm_controllers = _executable("arm_controllers")

if __name__ == "__main__":
    sys.exit(_executable(sys.argv.pop(1))())
