"""Properties of all nodes: how they report, tick and end, and how they are discovered with the user's settings."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from q2r2_control.ros.launch.executables import NODES
from q2r2_control.ros.launch.middleware import set_up_middleware
from tests.ros.conftest import need_ros
from tests.ros.processes import PATIENCE, ROOT, Processes, States, as_arguments, environment_of, wait_until

need_ros()

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from std_msgs.msg import String
from std_srvs.srv import Trigger

from q2r2_control.ros.base_node import LATCHED_QOS, BaseNode
from q2r2_control.ros.executor import TickExecutor


def test_only_the_thread_that_ticks_has_real_time_priority_where_permitted(node: Any, processes: Processes) -> None:
    if sys.platform != "linux":
        pytest.skip("only Linux has SCHED_FIFO")
    states = States(node, "simulation_input")
    process = processes.start_node("SimulationInput", "realtime_priority:=7")
    states.wait_for(without_subscriber=["left", "right"])
    refused = "no SCHED_FIFO" in process.output
    expected = (0, 0) if refused else (os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, 7)
    threads = [int(name) for name in os.listdir(f"/proc/{process.pid}/task")]
    found = [(os.sched_getscheduler(thread), os.sched_getparam(thread).sched_priority) for thread in sorted(threads)]
    assert found[0] == expected
    assert set(found[1:]) == {(0, 0)}


# The program runs an entry point, and interrupts itself as Ctrl-C does, just before a module is imported.
RUN = """
import os, signal, sys
from importlib import import_module

class Interrupter:
    def find_spec(self, name, path=None, target=None):
        if name == {at!r}:
            os.kill(os.getpid(), signal.SIGINT)

module, _, function = {entry!r}.partition(":")
sys.meta_path.insert(0, Interrupter())
getattr(import_module(module), function)()
"""
SCRIPTS: dict[str, str] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]


@pytest.mark.parametrize("name", ["q2r2", "arm_controllers", "mujoco_robot"])
def test_ctrl_c_while_importing_ends_a_command_and_prints_nothing(name: str) -> None:
    at = f"q2r2_control.ros.nodes.{NODES[name][0]}" if name in NODES else "q2r2_control.cli.app"
    code = RUN.format(at=at, entry=SCRIPTS[name])
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert (run.stdout, run.stderr) == ("", "")
    assert run.returncode == -signal.SIGINT


def test_the_help_of_an_executable_describes_its_node_and_starts_no_node(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "q2r2_control.ros.launch.executables", "recorder", "--help"]
    path = {"PYTHONPATH": os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))}
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, env=os.environ | path)
    assert (run.returncode, run.stderr) == (0, "")
    assert run.stdout.startswith("``recorder``: writes what the nodes of a cell publish")
    assert "--ros-args -p NAME:=VALUE" in run.stdout
    assert list(tmp_path.iterdir()) == []


def test_a_controller_refuses_an_arm_with_a_link_that_is_not_monitored(domain: int, tmp_path: Path) -> None:
    (file := tmp_path / "z1.yaml").write_text(
        "name: z1\narms:\n  left:\n    model: example-robot-data:z1\n    tip: gripperStator\n"
        "    home: [0, 1, -0.5, 0, 0, 0]\n"
    )
    command = [sys.executable, "-m", "q2r2_control.ros.launch.executables", "cartesian_controller"]
    command += as_arguments(f"config:={file}")
    environment = environment_of(domain, tmp_path)
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, env=environment)
    assert run.returncode == 2
    assert "z1: left_link01: weighs 0.673 kg and has" in run.stderr
    assert "has no collision shape, so that nothing keeps it off anything; allowed: <collision>" in run.stderr


def test_a_ctrl_c_that_comes_while_python_starts_ends_the_executable_without_output() -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "q2r2_control.ros.launch.executables", "mujoco_robot"],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        preexec_fn=lambda: signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}),
    )
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=120)
    assert (output, process.returncode) == ("", -signal.SIGINT)


HANGS = """
import os, signal, sys, time
from q2r2_control.ros.base_node import BaseNode
from q2r2_control.ros.launch import executables

def left():
    return signal.getitimer(signal.ITIMER_REAL)[0]

class Node(BaseNode):
    exit_code, priority = 0, 5

    def __init__(self):
        super().__init__("hangs")

    def close(self):
        steady = time.monotonic
        time.monotonic = lambda: steady() + 3.0  # it brakes for so long

    def destroy_node(self):
        print(os.sched_getscheduler(0) == os.SCHED_OTHER, 0.0 < left() <= 2.0, flush=True)
        while HANGS:
            pass
        super().destroy_node()

HANGS = sys.argv.pop() == "hangs"
executables.NODES["hangs"] = "hangs", "Node"
sys.modules["q2r2_control.ros.nodes.hangs"] = sys.modules["__main__"]
print(executables._executable("hangs")(), 0.0 < left() <= 2.0)
"""


@pytest.mark.parametrize(("hangs", "said", "code"), [("hangs", "", -signal.SIGALRM), ("ends", "0 True\n", 0)])
def test_before_its_end_a_node_drops_its_priority_and_it_ends_in_time_even_if_its_middleware_hangs(
    hangs: str, said: str, code: int
) -> None:
    command = [sys.executable, "-c", HANGS, hangs]
    run = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, timeout=120)
    assert (run.stdout, run.returncode) == (f"True True\n{said}", code)


LISTENER = """
import rclpy
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node("listener")
node.create_subscription(String, "/words", lambda message: print(message.data, flush=True), 10)
rclpy.spin(node)
"""


@pytest.mark.parametrize(
    "environment",
    [
        {"FASTRTPS_DEFAULT_PROFILES_FILE": "my.xml"},
        {"FASTDDS_BUILTIN_TRANSPORTS": "LARGE_DATA", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"},
        {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"},
        {"ROS_LOCALHOST_ONLY": "1"},
        {"ROS_STATIC_PEERS": "192.168.1.7", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"},
    ],
)
def test_middleware_settings_of_the_user_are_kept(environment: dict[str, str]) -> None:
    before = dict(environment)
    set_up_middleware(environment)
    assert environment == before


@pytest.mark.parametrize("ours", [{}, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}], ids=["subnet", "localhost"])
def test_without_settings_of_the_user_the_shipped_profile_is_set_and_kept(ours: dict[str, str]) -> None:
    set_up_middleware(ours)
    assert Path(ours["FASTRTPS_DEFAULT_PROFILES_FILE"]).is_file()
    # Both results allow only UDP. The first one does so by a variable. The second one does so by its profile, and needs
    # this range, with which ROS 2 adds no shared memory.
    assert (
        ours.get("FASTDDS_BUILTIN_TRANSPORTS") == "UDPv4" or ours["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "SYSTEM_DEFAULT"
    )
    once = dict(ours)
    set_up_middleware(ours)
    assert ours == once


def shared_memory(process: Any) -> list[str]:
    mapped = Path(f"/proc/{process.pid}/maps")
    if not mapped.exists():
        pytest.skip("needs /proc")
    return [line for line in mapped.read_text().splitlines() if "/dev/shm/fastrtps" in line]


def test_a_node_that_is_confined_to_this_machine_hears_other_nodes_and_uses_no_shared_memory(
    node: Any, processes: Processes
) -> None:
    environment = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    set_up_middleware(environment)
    listener = processes.start(sys.executable, "-c", LISTENER, name="listener", **environment)
    publisher = node.create_publisher(String, "/words", 10)
    wait_until(lambda: publisher.publish(String(data="hello")) or "hello" in listener.output, "the listener hears")
    assert not shared_memory(listener)


PERIOD = 0.01  # Period of the node's tick [s].


class Ticking(BaseNode):
    ticks = True

    def __init__(self, context: Any) -> None:
        super().__init__("ticking", context=context)
        self.log: list[str] = []

    def listen(self, qos: Any = 10) -> Any:
        publisher = self.create_publisher(String, "words", qos)
        self.create_subscription(String, "words", lambda message: self.log.append(message.data), qos)
        return publisher


@pytest.fixture
def ticking(context: Any) -> Iterator[Ticking]:
    node = Ticking(context)
    yield node
    node.destroy_node()


@pytest.fixture
def executor(ticking: Ticking, context: Any) -> Iterator[TickExecutor]:
    made = TickExecutor(context=context)
    made.add_node(ticking)
    yield made
    made.shutdown()


def spin_until(executor: Any, condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        executor.spin_once(timeout_sec=0.1)


def say(publisher: Any, executor: TickExecutor, *words: str) -> None:
    spin_until(executor, publisher.get_subscription_count)
    for word in words:
        publisher.publish(String(data=word))
    time.sleep(0.1)


def test_all_messages_that_have_arrived_are_taken_in_order_before_the_tick(
    ticking: Ticking, executor: TickExecutor
) -> None:
    times: list[Mapping[str, int]] = []
    ticking.create_subscription(String, "words", lambda _, info: times.append(info), 10)
    say(ticking.listen(), executor, "one", "two", "three")
    ticking.create_tick(PERIOD, lambda: ticking.log.append("tick"))
    spin_until(executor, lambda: "tick" in ticking.log)
    assert ticking.log[:4] == ["one", "two", "three", "tick"]
    assert 0 < times[-1]["source_timestamp"] <= times[-1]["received_timestamp"]


def test_the_executor_delivers_latched_messages_and_runs_no_cancelled_tick(
    ticking: Ticking, executor: TickExecutor
) -> None:
    timer = ticking.create_tick(PERIOD, lambda: ticking.log.append("tick"))
    ticking.listen(LATCHED_QOS).publish(String(data="said before"))
    spin_until(executor, lambda: {"tick", "said before"} <= set(ticking.log))
    timer.cancel()
    ticking.log.clear()
    for _ in range(20):
        executor.spin_once(timeout_sec=PERIOD)
    assert ticking.log == []


def test_if_a_callback_destroys_a_subscription_this_subscription_gets_no_further_message(
    ticking: Ticking, executor: TickExecutor
) -> None:
    subscriptions: list[Any] = []

    def hear(message: Any) -> None:
        ticking.log.append(message.data)
        while subscriptions:
            ticking.destroy_subscription(subscriptions.pop())

    publisher = ticking.create_publisher(String, "words", 10)
    subscriptions += [ticking.create_subscription(String, "words", hear, 10) for _ in range(2)]
    spin_until(executor, lambda: publisher.get_subscription_count() == 2)
    say(publisher, executor, "one", "two")
    for _ in range(3):
        executor.spin_once(timeout_sec=0.05)
    assert ticking.log == ["one"]


def test_the_executor_answers_services_and_runs_coroutines(ticking: Ticking, executor: TickExecutor) -> None:
    def serve(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = True
        return response

    ticking.create_service(Trigger, "serve", serve, callback_group=ReentrantCallbackGroup())
    client = ticking.create_client(Trigger, "serve", callback_group=ReentrantCallbackGroup())

    async def ask() -> None:
        ticking.log.append("asks")
        timer.cancel()
        answer = await client.call_async(Trigger.Request())
        ticking.log.append(f"success: {answer.success}")

    spin_until(executor, client.service_is_ready)
    timer = ticking.create_timer(PERIOD, ask)
    spin_until(executor, lambda: len(ticking.log) == 2)
    assert ticking.log == ["asks", "success: True"]


@pytest.mark.parametrize("make", [BaseNode.create_tick, BaseNode.create_timer], ids=["a tick", "a slow timer"])
def test_a_timer_that_another_timer_destroys_does_not_run(make: Any, ticking: Ticking, executor: TickExecutor) -> None:
    timers: list[Any] = []

    def run() -> None:
        ticking.log.append("ran")
        while timers:
            ticking.destroy_timer(timers.pop())

    timers += [make(ticking, PERIOD, run) for _ in range(2)]
    time.sleep(2.0 * PERIOD)  # Both timers are due now.
    spin_until(executor, lambda: ticking.log)
    for _ in range(3):
        executor.spin_once(timeout_sec=0.05)
    assert ticking.log == ["ran"]


@pytest.mark.parametrize("make", [BaseNode.create_tick, BaseNode.create_timer], ids=["a tick's", "a slow timer's"])
def test_the_executor_raises_the_error_of_a_callback(make: Any, ticking: Ticking, executor: TickExecutor) -> None:
    def fail() -> None:
        raise ValueError("of the callback")

    make(ticking, PERIOD, fail)
    with pytest.raises(ValueError, match="of the callback"):
        spin_until(executor, lambda: False)


def test_an_executor_of_rclpy_also_runs_ticks_and_callbacks_of_messages(ticking: Ticking, context: Any) -> None:
    plain, publisher = SingleThreadedExecutor(context=context), ticking.listen()
    plain.add_node(ticking)
    ticking.create_tick(PERIOD, lambda: ticking.log.append("tick"))
    spin_until(plain, publisher.get_subscription_count)
    publisher.publish(String(data="one"))
    spin_until(plain, lambda: {"one", "tick"} <= set(ticking.log))
    plain.shutdown()


def test_the_executor_ends_with_its_context(executor: TickExecutor, context: Any) -> None:
    executor.spin_once(timeout_sec=0.0)
    context.try_shutdown()
    with pytest.raises(ExternalShutdownException):
        spin_until(executor, lambda: False)
