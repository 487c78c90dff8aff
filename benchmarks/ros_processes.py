"""Nodes as processes in a ROS domain of their own, and their processor time, for the benchmarks of ROS."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import domain_coordinator

from q2r2_control.ros.launch.middleware import set_up_middleware
from q2r2_control.ros.launch.processes import NodeProcess


@contextmanager
def private_domain() -> Iterator[None]:
    """Use a free ROS domain of this host only. Thus no message goes to a robot on the network or comes from it."""
    with domain_coordinator.domain_id() as number:
        private = {"ROS_DOMAIN_ID": str(number), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        before = dict(os.environ)
        os.environ.update(private)
        set_up_middleware(os.environ)
        try:
            yield
        finally:
            os.environ.clear()
            os.environ.update(before)


@contextmanager
def started(nodes: Sequence[NodeProcess]) -> Iterator[dict[str, int]]:
    """Run the nodes as processes, and yield their ids by name. At the end, interrupt them in reverse order."""
    processes = [
        subprocess.Popen(node.command(), stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL) for node in nodes
    ]
    try:
        yield {node.name: process.pid for node, process in zip(nodes, processes, strict=True)}
    finally:
        for process in reversed(processes):
            process.send_signal(signal.SIGINT)
        for process in reversed(processes):
            try:
                process.wait(10.0)
            except subprocess.TimeoutExpired:
                process.kill()


def processor_time(pid: int) -> float:
    """Return the processor time of a process since its start, from Linux's /proc [s]."""
    # The fields are counted after the process name in parentheses, because this name may contain spaces.
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
