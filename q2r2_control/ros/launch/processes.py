"""The nodes that a cell needs, and ``q2r2 ros up``, which runs them as processes that start and end together."""

from __future__ import annotations

import ctypes
import importlib.util
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

from q2r2_control.config.cell_file import load_config
from q2r2_control.config.external import ControllerKind, ExternalConfig
from q2r2_control.errors import NOT_RECORDED, ConfigError, Q2R2Error
from q2r2_control.extras import install_line, require
from q2r2_control.plugins import INPUTS, load_class
from q2r2_control.process.scheduling import StopRequest, how_it_ended, stop_on_signals
from q2r2_control.ros.launch.build import build_missing
from q2r2_control.types import SIDES

_EXTRAS = {"mujoco_robot": "sim", "recorder": "data"}  # By node, the extra of this package that the node needs.
NO_INPUT = "none"  # Another node sends the data of the hands.
ROBOTS = ("auto", "mujoco", "none")
# Time for a process to end, after SIGINT and then after SIGTERM; SIGKILL follows [s].
_END_TIMEOUTS = {signal.SIGINT: 5.0, signal.SIGTERM: 3.0}
# Few calls are safe between fork and exec. This function is therefore looked up before any fork.
_prctl = ctypes.CDLL(None).prctl if sys.platform == "linux" else None
_NAMESPACE = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
# The log lines of a process begin with the name of the node. They are therefore passed on without the process's name.
_LOG_FORMAT = {"RCUTILS_CONSOLE_OUTPUT_FORMAT": "[{name}] {severity}: {message}"}
_LOG_LINE = re.compile(r"\[[\w.]+\] (DEBUG|INFO|WARN|ERROR|FATAL): ")
_PR_SET_PDEATHSIG = 1
_EXECUTABLES = "q2r2_control.ros.launch.executables"


@dataclass(frozen=True, slots=True)
class NodeProcess:
    """One process to start, with the name of its executable and the parameters of its nodes."""

    name: str
    parameters: Mapping[str, str | float] = field(default_factory=dict)
    ros_arguments: tuple[str, ...] = ()  # Further arguments for ROS, such as "-r", "__ns:=/cell".

    def command(self) -> list[str]:
        """Return the command that starts the process with this Python. A text such as "3" stays a text."""
        parameters = [
            part
            for key, value in self.parameters.items()
            for part in ("-p", f"{key}:={json.dumps(value, ensure_ascii=False)}")
        ]
        return [sys.executable, "-u", "-m", _EXECUTABLES, self.name, "--ros-args", *parameters, *self.ros_arguments]


def nodes_of(
    path: str,
    source: str | None = None,
    robot: str = "auto",
    recording: Mapping[str, str | float] | None = None,
    separate: bool = False,
    page: tuple[str, int] | None = None,
) -> list[NodeProcess]:
    """Return the processes for a cell, in the order of their start; raises :class:`ConfigError`.

    Args:
        path: The YAML of the cell.
        source: The source of the hands: an installed input, "none", or None for the cell's input.
        robot: "mujoco", "none", or "auto", which is mujoco for ``controller: builtin`` and else none.
        recording: Parameters of the recorder, which starts first and ends last; None for no recorder.
        separate: Whether each arm has a process and a teleoperation of its own.
        page: Host and port of the page in a browser; None for no page.
    """
    if robot not in ROBOTS:
        raise ConfigError(f"robot = {robot!r:.60}: allowed are {', '.join(ROBOTS)}")
    cell = load_config(path)
    source = source or cell.input
    config: dict[str, str | float] = {"config": path}
    nodes = [] if recording is None else [NodeProcess("recorder", {**config, **recording})]
    controller: dict[str, str | float] = {} if cell.external is None else _relayed(cell.external)
    if robot == "mujoco" or (robot == "auto" and cell.controller is ControllerKind.BUILTIN):
        nodes.append(NodeProcess("mujoco_robot", config))
        if cell.external is None:
            controller["external_torque_topic"] = "mujoco_robot/external_torque"
    if cell.external is None or cell.external.filtered:
        nodes.append(NodeProcess("cartesian_controller", config | controller))
    arms = [f"{arm}_arm_controller" for arm in SIDES if arm in cell.arms]
    together = not separate and len(arms) == len(SIDES)
    nodes += [NodeProcess(name, config) for name in (["arm_controllers"] if together else arms)]
    if source != NO_INPUT:
        executable = getattr(load_class(INPUTS, source), "executable", "hand_input")
        # In a cell with one arm, no node uses the other hand.
        hands = [cell.teleop.stance.hand_of(str(arm)) for arm in cell.arms]
        side: dict[str, str | float] = {"side": hands[0]} if len(hands) == 1 else {}
        nodes.append(NodeProcess(executable, config | {"input": source} | side))
    if page is not None:
        host, port = page
        address: dict[str, str | float] = {"web_host": host, "web_port": port, "recorded": recording is not None}
        nodes.append(NodeProcess("web_page", config | address))
    return nodes


def in_ros(
    nodes: Iterable[NodeProcess], arguments: Sequence[str], namespace: str | None, sim_time: bool
) -> list[NodeProcess]:
    """Return ``nodes`` with more ``arguments`` for ROS, in a ``namespace``. With ``sim_time``, /clock gives the time.

    Raises :class:`ConfigError` for an invalid namespace.
    """
    given: list[str] = []
    if namespace is not None:
        if not _NAMESPACE.fullmatch(namespace):
            raise ConfigError(f"--namespace = {namespace!r:.60}: allowed is a ROS name such as /cell")
        given += ["-r", f"__ns:=/{namespace.removeprefix('/')}"]
    if sim_time:
        given += ["-p", "use_sim_time:=true"]
    return [replace(node, ros_arguments=(*node.ros_arguments, *given, *arguments)) for node in nodes]


def _relayed(external: ExternalConfig) -> dict[str, str | float]:
    """Return the parameters of the built-in controller in mode filtered, for safe targets or joint commands."""
    preset = external.terms
    parameters: dict[str, str | float] = {"output": preset.output}
    if not preset.takes_targets:
        parameters["rate"] = float(external.rate or preset.rate)
    for arm, theirs in external.arms.items():
        parameters[f"{arm}.target_frame_id"] = external.world_frame or theirs.base_frame
        parameters[f"{arm}.joint_states_topic"] = theirs.joint_states_topic
        if not preset.takes_targets:
            parameters[f"{arm}.output_topic"] = external.topic(arm)
    return parameters


class UpError(Q2R2Error):
    """ROS cannot be used here. The message says what is missing."""


def run_together(nodes: Sequence[NodeProcess], say: Callable[[str], None]) -> int:
    """Start ``nodes`` and pass each line that they print to ``say``; returns the exit code.

    Each line begins with the name of the node whose log contains the line, or else with the name of the process.

    Ctrl-C or SIGTERM ends all nodes. The exit code is then 0, or 3 if a node reports by this code that its recording
    failed. If a node ends by itself, this is reported at once, the others are ended, and the exit code is 1. No node is
    restarted. Each node runs in a session of its own. Ctrl-C in a terminal therefore reaches the nodes only through
    this function, one after the other. If this process is killed, Linux interrupts all nodes, because arms must not
    move in a teleoperation that cannot be ended. ``say`` is called by several threads, one at a time. Missing message
    packages are built first.

    Raises:
        UpError: If ROS cannot be used.
        MissingPackageError: If a package of an extra is missing for a node.
        BuildError: If message packages cannot be built.
    """
    check_rclpy()
    for node in nodes:
        if (extra := _EXTRAS.get(node.name)) is not None:
            require(extra, node.name)
    build_missing(say)
    stop, lock = StopRequest(), threading.Lock()
    running: dict[str, subprocess.Popen[str]] = {}
    readers: list[threading.Thread] = []

    def say_alone(line: str) -> None:
        with lock:
            say(line)

    with stop_on_signals(stop.ask):
        try:
            for node in nodes:
                running[node.name] = _start(node)
            for name, process in running.items():  # Threads start last, because it is safer to fork without threads.
                readers.append(threading.Thread(target=_read, args=(name, process, say_alone), daemon=True))
                readers[-1].start()
            dead = _watch(running, stop, say_alone)
        finally:
            _end(running, say_alone)
            for reader in readers:
                reader.join(1.0)
    if dead:
        say_alone(f"[up] {dead} ended by itself; all others have been stopped")
        return 1
    failed = [name for name, process in running.items() if process.returncode == NOT_RECORDED]
    say_alone(f"[up] all stopped, but the recording of {failed[0]} failed" if failed else "[up] all stopped")
    return NOT_RECORDED if failed else 0


def check_rclpy() -> None:
    """Raise :class:`UpError` if there is no ROS."""
    if importlib.util.find_spec("rclpy") is None:
        cure = f"{install_line('ros')}, or source a ROS 2 Jazzy"
        raise UpError(f"rclpy cannot be imported: {cure}")


def _start(node: NodeProcess) -> subprocess.Popen[str]:
    parent = os.getpid()
    return subprocess.Popen(
        node.command(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        env=_LOG_FORMAT | os.environ | {"PYTHONUNBUFFERED": "1"},  # A format that the user has set is kept.
        start_new_session=True,
        preexec_fn=None if _prctl is None else lambda: _end_with(parent),
    )


def _end_with(parent: int) -> None:
    """Let Linux send SIGINT to this new process when ``parent`` ends, which may have happened already.

    The signal is blocked until the executable unblocks it, because a starting interpreter would print a traceback.
    """
    assert _prctl is not None
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    _prctl(_PR_SET_PDEATHSIG, signal.SIGINT)
    if os.getppid() != parent:
        os.kill(os.getpid(), signal.SIGINT)


def _read(name: str, process: subprocess.Popen[str], say: Callable[[str], None]) -> None:
    for line in process.stdout or ():
        say(line.rstrip() if _LOG_LINE.match(line) else f"[{name}] {line.rstrip()}")


def _watch(running: Mapping[str, subprocess.Popen[str]], stop: StopRequest, say: Callable[[str], None]) -> str | None:
    """Wait for the request to stop, or for a process to end by itself; return its name, or None."""
    while not stop.asked:
        for name, process in running.items():
            if (code := process.poll()) is not None:
                say(f"[up] {how_it_ended(f'{name} (process {process.pid})', code)}; stopping all others")
                return name
        time.sleep(0.02)
    return None


def _end(running: Mapping[str, subprocess.Popen[str]], say: Callable[[str], None]) -> None:
    """End all processes one by one in reverse order, so that the robot runs until the controller has braked it."""
    for name, process in reversed(list(running.items())):
        for number, timeout in _END_TIMEOUTS.items():
            if process.poll() is None:
                process.send_signal(number)
                with suppress(subprocess.TimeoutExpired):
                    process.wait(timeout)
        if process.poll() is None:
            say(f"[up] {name} (process {process.pid}) did not end and is killed")
            process.kill()
            process.wait()
