"""The executables of the nodes. During its imports, an executable ends on Ctrl-C at once and without a traceback.

Imports take seconds, and turn Ctrl-C into errors of many kinds. There is nothing to clean up yet, so the default action
of the signal is right until :func:`run_node` handles it.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from importlib import import_module

# For each executable: the name of a module of ``nodes``, and the name of a class or function in this module. The class
# is the class of a node. The function runs several nodes.
NODES = {
    "tcp_endpoint": ("tcp_endpoint", "TcpEndpoint"),
    "SimulationInput": ("simulation_input", "SimulationInput"),
    "hand_input": ("simulation_input", "HandInput"),
    "CheckTCPconnection": ("tcp_endpoint", "CheckTcpConnection"),
    "cartesian_controller": ("cartesian_controller", "CartesianControllerNode"),
    "mujoco_robot": ("mujoco_robot", "MujocoRobot"),
    "recorder": ("recorder", "RecorderNode"),
    "web_page": ("web_page", "WebPage"),
    "left_arm_controller": ("arm_controllers", "LeftArmController"),
    "right_arm_controller": ("arm_controllers", "RightArmController"),
    "arm_controllers": ("arm_controllers", "run_both_arms"),
}


def _executable(name: str) -> Callable[[], int]:
    def run() -> int:
        sys.argv[0] = name
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        # SIGINT is unblocked only now. q2r2 ros up has blocked it, because a SIGINT at the start of the interpreter
        # would cause a traceback.
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        module, made = NODES[name]
        imported = import_module(f"q2r2_control.ros.nodes.{module}")
        if {"-h", "--help"} & set(sys.argv):
            print(f"{imported.__doc__}\nParameters, which docs/ros.md has: {name} --ros-args -p NAME:=VALUE")
            return 0
        node_or_run = getattr(imported, made)
        from q2r2_control.ros.base_node import end_in_time, run_node

        code = run_node(node_or_run) if isinstance(node_or_run, type) else int(node_or_run())
        end_in_time()  # The time is limited, because the middleware can still be at work while the process ends.
        return code

    return run


tcp_endpoint = _executable("tcp_endpoint")
simulation_input = _executable("SimulationInput")
hand_input = _executable("hand_input")
check_tcp_connection = _executable("CheckTCPconnection")
cartesian_controller = _executable("cartesian_controller")
mujoco_robot = _executable("mujoco_robot")
recorder = _executable("recorder")
web_page = _executable("web_page")
left_arm_controller = _executable("left_arm_controller")
right_arm_controller = _executable("right_arm_controller")
arm_controllers = _executable("arm_controllers")

if __name__ == "__main__":
    sys.exit(_executable(sys.argv.pop(1))())
