"""``q2r2 fri-check``: listen to the cabinets of a cell for some seconds, and move nothing."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Annotated

import numpy as np
from rich.table import Table
from typer import Exit, Option

from q2r2_control.cli.output import ConfigFile, Json, Wait, longest_wait, print_report
from q2r2_control.config.cell_file import load_config
from q2r2_control.events import Reason
from q2r2_control.plants.fri.plant import FriPlant
from q2r2_control.plants.fri.wire import Monitoring, in_words
from q2r2_control.process.machine_notes import machine_notes, network_notes
from q2r2_control.process.scheduling import StopRequest, few_garbage_collections, real_time, stop_on_signals
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, CommandMode
from q2r2_control.viewer.tables import record_table
from q2r2_control.wording import sentence

_LOOKS = 2e-4  # Time between two checks for a new message [s].
_LARGE_JITTER = 0.5  # Jitter that causes a note, as a share of the period.


@dataclass(frozen=True, slots=True)
class CabinetReport:
    """Figures of one cabinet's messages, and the states that its newest message has, in words."""

    arm: str
    fri_version: int
    period_ms: float
    messages: int
    lost: int
    # 99th percentile of the absolute difference between the time from one message to the next and the cabinet's period.
    jitter_ms_p99: float
    jitter_ms_max: float
    session: str
    quality: str
    safety: str
    operation: str
    drives: str
    joints_deg: list[float]  # Measured joint positions.
    external_torque_nm: float | None  # The largest absolute external torque of a joint; None if it is not sent.


def cabinet_report(arm: str, heard: Sequence[tuple[Monitoring, float]], lost: int) -> CabinetReport:
    """Return the report on the messages ``heard``, in their order, each with its time of arrival [s].

    There must be at least one message. ``lost`` is the number of lost messages.
    """
    newest = heard[-1][0]
    counters = np.array([message.counter for message, _ in heard])
    late = np.abs(np.diff([came for _, came in heard]) - np.diff(counters) * newest.period)
    return CabinetReport(
        arm=arm,
        fri_version=newest.version,
        period_ms=1e3 * newest.period,
        messages=len(heard),
        lost=lost,
        jitter_ms_p99=1e3 * float(np.quantile(late, 0.99)) if len(late) else 0.0,
        jitter_ms_max=1e3 * float(late.max(initial=0.0)),
        session=in_words(newest.session),
        quality=in_words(newest.quality),
        safety=in_words(newest.safety),
        operation=in_words(newest.operation),
        drives=in_words(newest.drives),
        joints_deg=np.degrees(newest.q).round(2).tolist(),
        external_torque_nm=None if newest.external_tau is None else max(map(abs, newest.external_tau)),
    )


@dataclass(frozen=True, slots=True)
class Heard:
    """Messages of the cabinets over some seconds, and the delays of the answers."""

    cabinets: list[CabinetReport]
    answers: Array  # (n,) Time from the arrival of each message until its answer was sent [s].
    fault: Reason | None  # The reason why the arms could not be commanded at the end; None if they could.
    notes: list[str]

    def table(self, duration: float) -> Table:
        """Return a table of the cabinets; ``duration`` is the time of listening [s]."""
        return record_table(f"cabinets, for {duration:g} s", self.cabinets, self.notes)


def listen(plant: FriPlant, duration: float, asked: Callable[[], bool] = lambda: False) -> Heard:
    """Listen to the cabinets of a plant that was reset, and return the figures of their messages.

    It listens for ``duration`` [s], or until ``asked`` returns True, for example after Ctrl-C.
    """
    heard: dict[str, list[tuple[Monitoring, float]]] = {arm: [] for arm in plant.states()}
    end = time.monotonic() + duration
    while (now := time.monotonic()) < end and not asked():
        for arm, state in plant.states().items():
            if state.newest is not None and (not heard[arm] or state.arrival > heard[arm][-1][1]):
                heard[arm].append((state.newest, state.arrival))
        time.sleep(_LOOKS)
    plant.due(now)
    fault, answers = plant.fault(), np.array([took for _, took in plant.answers])
    reports = [cabinet_report(arm, messages, plant.states()[arm].lost) for arm, messages in heard.items()]
    notes = [f"{arm}: gripper {gripper.in_words()}" for arm, gripper in plant.grippers.items()]
    notes += machine_notes() + network_notes(plant.addresses)
    for its in reports:
        if its.jitter_ms_p99 > _LARGE_JITTER * its.period_ms:
            notes.append(f"{its.arm}: messages come uneven by over half a period: the network, or a busy computer")
    if fault is not None:
        notes.append(sentence(fault))
    if len(answers):
        median, late = 1e3 * np.quantile(answers, (0.5, 0.99))
        notes.insert(0, f"answered after {median:.2f} ms, median, and {late:.2f} ms, p99")
    return Heard(reports, answers, fault, notes)


def fri_check(
    config: ConfigFile,
    duration: Annotated[float, Option(min=1, max=3600, help="Time to listen [s].")] = 10.0,
    wait: Wait = None,
    json: Json = False,
) -> None:
    """Listen to the cabinets of a cell and say what they send.

    Exit code 1 if an arm could not be commanded. The messages are answered, so that the connection becomes good. If an
    application starts its overlay meanwhile, the arm is held where it is. Move an arm by hand guiding, and see which
    numbers change.
    """
    cell, stop = load_config(config), StopRequest()
    plant = FriPlant(Robot.from_config(cell), cell)
    plant.begin(CommandMode.POSITION, lambda: stop.asked)
    plant.longest_wait = longest_wait(wait)
    with stop_on_signals(stop.ask), real_time(), few_garbage_collections():
        try:
            plant.reset()
            heard = listen(plant, duration, lambda: stop.asked)
        finally:
            plant.close()
    data = {
        "cabinets": [asdict(report) for report in heard.cabinets],
        "answers_s": heard.answers.tolist(),
        "notes": heard.notes,
    }
    print_report(data, (heard.table(duration),), json)
    raise Exit(0 if heard.fault is None else 1)
