"""``q2r2 bench``: figures of this machine, from real ticks and real nodes."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import Annotated, NoReturn

import typer
from rich.console import Console

from q2r2_control.benchmark.peers.base import PEERS
from q2r2_control.benchmark.tick_times import run_bench
from q2r2_control.cli.bench_tables import deeds_table, latency_table, soak_table, times_table
from q2r2_control.cli.cell_run import notice_of_compiling
from q2r2_control.cli.json_output import as_json_text
from q2r2_control.config import load_config
from q2r2_control.errors import ConfigError
from q2r2_control.verification.soak import SoakReport, run_soak

_CONFIG = "config/dual_iiwa7.yaml"
_TICKS, _SOAK_TICKS, _SECONDS = 3000, 1_000_000, 30.0
_RATE = 250.0  # of the controller's node by default [Hz]


def bench(
    ticks: Annotated[
        int | None, typer.Option(min=100, help=f"Of each scenario, {_TICKS} by itself; soak: {_SOAK_TICKS}.")
    ] = None,
    peers: Annotated[bool, typer.Option(help="Time roboplan, mink and pink too, where they are installed.")] = True,
    soak: Annotated[
        bool, typer.Option("--soak", help="Check every promise in hostile ticks instead of timing.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of the soak.")] = 0,
    ros: Annotated[bool, typer.Option("--ros", help="Time the way through the ROS nodes instead.")] = False,
    duration: Annotated[
        float | None, typer.Option(min=1, max=3600, help=f"Of each way in, {_SECONDS:g} by itself; with --ros [s].")
    ] = None,
    rate: Annotated[
        float | None, typer.Option(min=20, max=1000, help=f"Of the controller's node, {_RATE:g}; with --ros [Hz].")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout, and all else on stderr.")] = (
        False
    ),
) -> None:
    """Time one tick of the controller with both arms, every pair and the certificate, and public peers beside it.

    With --soak: random hostile targets, ticks, starts and solver failures; every promise of the controller is checked
    at every tick, and the worst margin of each is printed. Exit 1 if one was broken.

    With --ros: the time from a message on an input topic to the joint command that answers it, through real nodes on
    this machine, in a domain of their own.
    """
    if soak and ros:
        raise ConfigError("--soak and --ros exclude each other")
    if seed and not soak:
        raise ConfigError("--seed needs --soak, since nothing else draws")
    if ros and ticks is not None:
        raise ConfigError("--ticks cannot be used with --ros, which takes --duration")
    if not ros and (duration is not None or rate is not None):
        raise ConfigError("--duration and --rate need --ros")
    console = Console(stderr=True)
    if ros:
        _show_latency(_SECONDS if duration is None else duration, rate or _RATE, console, json)
        return
    with notice_of_compiling(console):
        if soak:
            report = run_soak(load_config(_CONFIG), _SOAK_TICKS if ticks is None else ticks, seed, _progress(console))
            _show_soak(report, json)
        else:
            _show_times(_TICKS if ticks is None else ticks, tuple(PEERS) if peers else (), console, json)


def _show_times(ticks: int, peers: tuple[str, ...], console: Console, json: bool) -> None:
    report = run_bench(load_config(_CONFIG), ticks, peers, _progress(console))
    if json:
        print(as_json_text(report.as_json()))
    else:
        out = Console()
        out.print(times_table(report))
        out.print(deeds_table(report))


def _show_soak(report: SoakReport, json: bool) -> NoReturn:
    if json:
        print(as_json_text(report.as_json()))
    else:
        Console().print(soak_table(report))
    raise typer.Exit(0 if report.passed else 1)


def _show_latency(duration: float, rate: float, console: Console, json: bool) -> None:
    missing = [name for name in ("rclpy", "quest2ros", "domain_coordinator") if importlib.util.find_spec(name) is None]
    if missing:
        raise ConfigError(
            f"--ros: {', '.join(missing)} cannot be imported: pip install 'q2r2_control[ros]' and "
            "q2r2 ros build-interfaces, or source a ROS 2 Jazzy"
        )
    from q2r2_control.benchmark.ros_latency import measure_latency  # all else works without ROS

    report = measure_latency(_CONFIG, duration, rate, _progress(console))
    if json:
        print(as_json_text(report.as_json()))
    else:
        Console().print(latency_table(report))


def _progress(console: Console) -> Callable[[str], None]:
    """Prints lines, to people only: a live line would need a thread, which would be in the times."""
    if not console.is_terminal:
        return lambda what: None
    return lambda what: console.print(what, highlight=False)
