"""``q2r2 fri-cabinet``: simulate the cabinets of a cell and their arms."""

from __future__ import annotations

import math
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from json import loads
from tempfile import TemporaryFile
from typing import Annotated, Any

from rich.console import Console
from typer import Option

from q2r2_control.cli.output import ConfigFile, Json, RealTime, positive, print_report, say
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.fri import GripperIoConfig
from q2r2_control.demo.assembly_tasks import AssemblyTask, TaskResult, TaskWatch, tasks_named
from q2r2_control.errors import ConfigError, PlantError
from q2r2_control.plants.fri.answering import address_for
from q2r2_control.plants.fri.cabinet import Cabinet, Trip
from q2r2_control.plants.fri.cabinet_server import CabinetServer, Network, SimulatedArms, settings_of
from q2r2_control.plants.fri.wire import CommandKind, Operation, Safety, Session, in_words
from q2r2_control.process.scheduling import StopRequest, few_garbage_collections, real_time, stop_on_signals
from q2r2_control.robot.robot import Robot
from q2r2_control.types import CommandMode
from q2r2_control.viewer.tables import figure_table

# Time between two judgements of tasks [s]. Judgements at this rate do not make a cabinet late.
_JUDGED_EVERY = 0.005
# Time between two readings of the lines that the cabinets print [s], and largest size of all these lines [bytes].
_LOOKS, _LONGEST_LINES = 0.05, 1 << 16
_SAFETY_STOP = 1.0  # Duration of a safety stop [s].
_KINDS = {CommandMode.POSITION: CommandKind.POSITION, CommandMode.TORQUE: CommandKind.TORQUE}


class Pendant:
    """Acts as the operator at the pendants of the cabinets, and prints the states of the sessions.

    It starts the overlays. It also ends sessions of the first cabinet, each after a time that the user has chosen.
    """

    def __init__(
        self,
        cabinets: dict[str, Cabinet],
        start_after: float,
        drop_every: float | None,
        safety_stop_every: float | None,
        console: Console,
    ) -> None:
        self._cabinets, self._start_after, self._console = cabinets, start_after, console
        self._drop_every, self._safety_stop_every = drop_every or math.inf, safety_stop_every or math.inf
        self._said: dict[str, str] = {}
        self._ready_since: dict[str, float | None] = dict.fromkeys(cabinets)
        self._active_since, self._stopped_at = math.inf, 0.0
        self._held = False

    def toggle(self) -> None:
        """End the sessions of all arms, or allow them to begin again."""
        self._held = not self._held
        say("overlays are stopped, Enter starts them" if self._held else "overlays start", self._console)
        for cabinet in self._cabinets.values() if self._held else ():
            cabinet.stop()

    def look(self, now: float) -> None:
        for arm, cabinet in self._cabinets.items():
            since = self._ready_since[arm]
            if cabinet.session is not Session.MONITORING_READY:
                self._ready_since[arm] = None
            elif since is None:
                self._ready_since[arm] = now
            elif now - since >= self._start_after and not self._held:
                cabinet.start_overlay()
            line = in_words(cabinet.session)
            if cabinet.trips and cabinet.session < Session.COMMANDING_WAIT:
                line += f" ({cabinet.trips[-1]})"
            if self._said.get(arm) != line:
                self._said[arm] = line
                say(f"{now:8.3f} s  {arm}: {line}", self._console)
        active = all(cabinet.session is Session.COMMANDING_ACTIVE for cabinet in self._cabinets.values())
        first = next(iter(self._cabinets.values()))
        self._active_since = min(self._active_since, now) if active else math.inf
        if now - self._stopped_at >= _SAFETY_STOP:
            first.safety_stop(Safety.NORMAL)
        if now - self._active_since >= self._safety_stop_every:
            first.safety_stop(Safety.STOP_1_ON_PATH)
            self._stopped_at = now
        elif now - self._active_since >= self._drop_every:
            first.stop()


def _enter_pressed() -> bool:
    """Return whether Enter was pressed. A background process does not read, because the terminal would stop it."""
    try:
        is_ours = os.tcgetpgrp(0) == os.getpgrp()
    except OSError:  # There is no terminal.
        return False
    return is_ours and bool(select.select([0], (), (), 0)[0]) and bool(os.read(0, 1024))


def fri_cabinet(
    config: ConfigFile,
    mode: Annotated[
        CommandMode, Option(help="What the application allows a client to command.")
    ] = CommandMode.POSITION,
    period: Annotated[float, Option(min=1, max=10, help="Time between two messages of a cabinet [ms].")] = 10.0,
    right_period: Annotated[
        float | None, Option(min=1, max=10, help="The same for the right arm's cabinet, if it differs [ms].")
    ] = None,
    multiplier: Annotated[int, Option(min=1, max=10, help="Messages for each answer: receiveMultiplier of FRI.")] = 1,
    stiffness: Annotated[
        float, Option(min=0, max=5000, help="Stiffness of the joint impedance in mode torque; it has to be 0 [Nm/rad].")
    ] = 0.0,
    fri: Annotated[int, Option(min=1, max=2, help="Version of FRI.")] = 2,
    source_port: Annotated[
        int | None,
        Option(min=0, max=65535, help="Port that messages come from, instead of the client's; 0: any free one."),
    ] = None,
    start_after: Annotated[float, Option(min=0, help="Time with a client after which the overlay starts [s].")] = 0.5,
    drop_every: Annotated[float | None, Option(help="Time in a session after which the pendant ends it [s].")] = None,
    safety_stop_every: Annotated[
        float | None, Option(help="Time in a session after which a safety stop of 1 s ends it [s].")
    ] = None,
    t1: Annotated[
        bool, Option("--t1", help="Operation mode T1, in which a tool must not be faster than 250 mm/s.")
    ] = False,
    wrong_load: Annotated[
        bool, Option("--wrong-load", help="The load data do not fit the tool, so that no client may command.")
    ] = False,
    loss: Annotated[float, Option(min=0, max=0.5, help="Share of datagrams that are lost, in each direction.")] = 0.0,
    duplicate: Annotated[float, Option(min=0, max=0.5, help="Share of messages that come twice.")] = 0.0,
    cut: Annotated[
        float, Option(min=0, max=0.5, help="Share of datagrams that lose their end, in each direction.")
    ] = 0.0,
    jitter: Annotated[
        float, Option(min=0, max=20, help="Largest delay of a datagram; later ones may overtake it [ms].")
    ] = 0.0,
    seed: Annotated[int, Option(min=0, help="Seed of losses and delays.")] = 0,
    task: Annotated[list[str] | None, Option(help="A task of q2r2 demo to judge. May be repeated.")] = None,
    duration: Annotated[float | None, Option(help="Duration [s]; by default until Ctrl-C.")] = None,
    rt: RealTime = False,
    json: Json = False,
) -> None:
    """Simulate the Sunrise cabinets of a cell, whose arms q2r2 run --plant fri can drive.

    Start q2r2 run CONFIG --plant fri in another terminal. As a real cabinet does, each simulated cabinet goes through
    the states of a session, guards the limits of its arm, and ends the session of a client that breaks a limit. The
    Enter key stands for the key of the pendant: it stops and starts the overlays. This is only a rehearsal, because
    KUKA's own controller and its safety functions are not simulated.
    """
    cell, console, stop = load_config(config), Console(stderr=True), StopRequest()
    if mode not in _KINDS:
        raise ConfigError(f"--mode {mode}: allowed: {', '.join(_KINDS)}")
    robot = Robot.from_config(cell)
    arms = SimulatedArms(robot, cell, stiffness)
    if missing := [arm for arm in robot.arms if arm not in cell.fri]:
        raise ConfigError(f"{config}: fri.{missing[0]}: missing; allowed: the cabinet of each arm")
    cabinets, origins, clients = {}, {}, {}
    for arm, its in cell.fri.items():
        every = right_period if arm == "right" and right_period is not None else period
        cabinets[str(arm)] = settings_of(robot, arm, _KINDS[mode], its.version or fri, 1e-3 * every, multiplier)
        client = clients[str(arm)] = address_for(its.address) or "127.0.0.1", its.port
        # A cabinet of KUKA uses the same port number as its client. If both have the same address, they cannot share a
        # port, so the simulated cabinet gets any free port.
        port = 0 if its.address == client[0] else its.port
        origins[str(arm)] = its.address, port if source_port is None else source_port
    grippers = {str(arm): its.gripper for arm, its in cell.fri.items() if isinstance(its.gripper, GripperIoConfig)}
    network = Network(loss, duplicate, 1e-3 * jitter, cut)
    server = CabinetServer(arms, cabinets, origins, clients, grippers, network, seed)
    for cabinet in server.cabinets.values():
        cabinet.load_fits = not wrong_load
        cabinet.operation = Operation.T1 if t1 else Operation.AUTOMATIC
    pendant = Pendant(server.cabinets, start_after, drop_every, safety_stop_every, console)
    watch = TaskWatch(tasks_named(task), arms.plant, robot, cell) if task else None
    longest = positive("--duration", duration)
    last = 0.0

    def look(now: float) -> None:
        nonlocal last
        if _enter_pressed():
            pendant.toggle()
        pendant.look(now)
        if watch is not None and now - last >= _JUDGED_EVERY:
            watch.look(now, now - last)
            last = now

    began = time.monotonic()
    with ExitStack() as stack:
        stack.enter_context(stop_on_signals(stop.ask))
        stack.enter_context(few_garbage_collections())
        if rt and (refused := stack.enter_context(real_time())) is not None:
            say(refused, console)
        server.run(lambda now: stop.asked or (longest is not None and now >= longest), look)
    data: dict[str, Any] = {"seconds": time.monotonic() - began, "cabinets": {}}
    rows = []
    for name, cabinet in server.cabinets.items():
        ends = [str(trip) for trip in cabinet.trips]
        state = in_words(cabinet.session)
        data["cabinets"][name] = {"state": state, "missed": cabinet.missed, "trips": ends}
        rows.append((name, state, cabinet.missed, ", ".join(sorted(set(ends))) or "-"))
    if watch is not None:
        data["tasks"] = watch.results()
    print_report(data, (figure_table("cabinets", ("arm", "state", "missed [answers]", "ends"), rows),), json)


def wait_for_states(child: subprocess.Popen[str], lines: int, count: int) -> None:
    """Wait until the process ``child`` has printed, for ``count`` arms, that their cabinets send messages.

    ``lines`` is the descriptor of the file into which the process prints. Raises :class:`PlantError` if it ends before.
    """
    said = ""  # All printed lines. They are read by ``pread``, because ``read`` would move the process's own position.
    while said.count(in_words(Session.MONITORING_WAIT)) < count:
        if child.poll() is not None:
            raise PlantError(f"the cabinets that stand in have ended: {said.strip() or 'without a word'}")
        time.sleep(_LOOKS)
        said = os.pread(lines, _LONGEST_LINES, 0).decode()


@contextmanager
def rehearsal(
    config: str, mode: CommandMode, tasks: Sequence[AssemblyTask], period: float, rt: bool
) -> Iterator[list[TaskResult]]:
    """Run the simulated cabinets of a cell in a separate process. The context begins when all of them send messages.

    Yield an empty list. When the context ends, the results of the ``tasks`` are added to the list. The process of the
    cabinets has measured them. ``period`` is the time between two messages [ms].

    Raises:
        PlantError: If the cabinets cannot begin, ended a session or gave no result.
    """
    words = [
        "fri-cabinet",
        config,
        "--mode",
        mode,
        "--period",
        str(period),
        "--json",
        *(["--rt"] if rt else ()),
        *(word for task in tasks for word in ("--task", task.name)),
    ]
    results: list[TaskResult] = []
    with TemporaryFile() as lines:
        child = subprocess.Popen(
            [sys.executable, "-m", "q2r2_control", *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=lines,
            text=True,
        )
        try:
            wait_for_states(child, lines.fileno(), len(load_config(config).fri))
            yield results
        finally:
            child.send_signal(signal.SIGINT)
            said, _ = child.communicate()
    try:
        told = loads(said)
    except ValueError:
        raise PlantError("the cabinets that stand in have failed; q2r2 fri-cabinet says why") from None
    for arm, cabinet in told["cabinets"].items():
        # The last entry may be LATE, because the cabinet gets no more answers after the end of our run.
        if cabinet["trips"][:-1] or cabinet["trips"][-1:] not in ([], [Trip.LATE]):
            raise PlantError(f"{arm}: the cabinet ended the session: {', '.join(cabinet['trips'])}")
    results += [TaskResult(**result) for result in told["tasks"]]
