"""Do ten watchers, and a client that sends garbage without a pause, slow down the loop of a run with a page?

The command q2r2 run --web runs twice in real time, while scripted hands move both arms round circles. In the second run
the watchers read everything that the page sends. A hostile client sends messages that no browser sends, and connects
again whenever it is disconnected. All these clients use the processors of the same machine as the run. Remote clients
would not.
"""

from __future__ import annotations

import json as json_module
import re
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Annotated
from urllib.parse import urlsplit

import numpy as np
import viser
from typer import Option, run
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from q2r2_control.cli.output import DEMO_CONFIG, Json, print_progress, print_report
from q2r2_control.viewer.tables import record_table

WATCHERS = 10
_RUN_ARGUMENTS = ("run", DEMO_CONFIG, "--input", "scripted", "--trajectory", "circle", "--plant", "kinematic")
_PAGE_ARGUMENTS = ("--headless", "--web", "--web-port", "0", "--json")
NOTES = (
    "tick: Time from the inputs until the command is applied [us].",
    "tracking: RMS error of the tool with the larger error.",
    "logged: Number of lines, and largest number of lines within one second.",
)


@dataclass(frozen=True)
class RunFigures:
    """The figures of one run. The time of a tick is from the inputs until the command is applied."""

    name: str
    loop_rate_hz: float
    tick_p50: float  # [us]
    tick_p99: float  # [us]
    tracking_mm: float  # RMS error of the tool with the larger error.
    fallback_ticks: int
    garbage: int  # Number of messages that the hostile client sent.
    logged: tuple[int, int]  # Number of logged lines, and largest number of lines within one second.


def joined(url: str) -> ClientConnection:
    """Return a client that connects as the page's own script does."""
    host = urlsplit(url).netloc
    protocol = [Subprotocol(f"viser-v{viser.__version__}")]
    return connect(f"ws://{host}", origin=Origin(f"http://{host}"), subprotocols=protocol, max_size=None)


class Crowd:
    """Clients in threads: :data:`WATCHERS` that read, and one that sends garbage."""

    def __init__(self, url: str) -> None:
        self._url, self._ended = url, threading.Event()
        self.garbage = 0
        self._threads = [threading.Thread(target=self._watch) for _ in range(WATCHERS)]
        self._threads.append(threading.Thread(target=self._disturb))
        for thread in self._threads:
            thread.start()

    def end(self) -> None:
        self._ended.set()
        for thread in self._threads:
            thread.join()

    def _watch(self) -> None:
        with suppress(ConnectionClosed, OSError), joined(self._url) as page:
            while not self._ended.is_set():
                with suppress(TimeoutError):
                    page.recv(timeout=0.5)

    def _disturb(self) -> None:
        random = np.random.default_rng(0)
        while not self._ended.is_set():
            with suppress(ConnectionClosed, InvalidHandshake, OSError), joined(self._url) as page:
                while not self._ended.is_set():
                    page.send(random.bytes(int(random.integers(0, 4096))))
                    self.garbage += 1


def measure(name: str, duration: float, crowd: bool) -> RunFigures:
    """Return the figures of one run of ``duration`` [s]."""
    print_progress(name)
    command = [sys.executable, "-m", "q2r2_control", *_RUN_ARGUMENTS, *_PAGE_ARGUMENTS, "--duration", f"{duration:g}"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stderr is not None
    lines: list[float] = []  # Time when each line of the log came [s].
    disturbers: list[Crowd] = []
    for line in process.stderr:
        if (found := re.search(r"page: (http\S+)", line)) is None:
            lines.append(time.monotonic())
        elif crowd:
            disturbers.append(Crowd(found[1]))
    for each in disturbers:
        each.end()
    summary = json_module.loads(process.stdout.read())
    if process.wait():
        sys.exit(f"The run has failed: {summary}")
    most = max(Counter(int(at - lines[0]) for at in lines).values(), default=0)
    return RunFigures(
        name=name,
        loop_rate_hz=summary["loop_rate_hz"],
        tick_p50=summary["tick_us"]["p50"],
        tick_p99=summary["tick_us"]["p99"],
        tracking_mm=max(arm["position_error_mm_rms"] for arm in summary["arms"].values()),
        fallback_ticks=summary["fallback_ticks"],
        garbage=sum(each.garbage for each in disturbers),
        logged=(len(lines), most),
    )


def main(
    duration: Annotated[float, Option(min=5.0, help="Duration of each run [s].")] = 60.0, json: Json = False
) -> None:
    """Measure a run without clients, and a run with a crowd on its page."""
    figures = [measure("alone", duration, False), measure("with the crowd", duration, True)]
    table = record_table(f"{WATCHERS} watchers and a hostile client on the page of a run", figures, NOTES)
    print_report({"duration_s": duration, "runs": [asdict(each) for each in figures]}, (table,), json)


if __name__ == "__main__":
    run(main)
