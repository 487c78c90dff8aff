"""``q2r2 bench``: compare the controller with public ones. ``q2r2 soak``: check its promises under hostile input."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict
from typing import Annotated

from rich.table import Table
from rich.text import Text
from typer import Exit, Option

from q2r2_control.benchmark.motion_run import PATIENCE, BenchReport, BenchRow, MotionFigures, run_bench
from q2r2_control.benchmark.peers.base import PEERS, WITHOUT_ACCELERATION_LIMIT
from q2r2_control.benchmark.solver_run import INSTALL, SOLVERS, SolverReport, run_solvers
from q2r2_control.benchmark.work_motions import TIMED_MOTIONS, WORK_MOTIONS, motions_named
from q2r2_control.cli.output import (
    DEMO_CONFIG,
    ClusterAddress,
    ConfigFile,
    Json,
    Solver,
    Workers,
    notice_of_compiling,
    print_progress,
    print_report,
    with_solver,
)
from q2r2_control.config.cell_file import load_config
from q2r2_control.errors import ConfigError
from q2r2_control.process.places import HERE, chosen_place
from q2r2_control.verification.fault_injection import FINGERS, with_contact
from q2r2_control.verification.policy_soak import COUNTED as POLICY_COUNTED
from q2r2_control.verification.policy_soak import PolicySoak
from q2r2_control.verification.soak import COUNTED, MEMORY_ALLOWED, SoakReport, run_soak
from q2r2_control.verification.soaks import run_soaks
from q2r2_control.viewer.tables import Cell, figure_table

_ROUNDS = 3
_NOTES = (
    "p50, p99: time of a tick",
    "RMS: distance of the worse tool from its target, from approach to rest; free: RMS of ours in free air",
    "there: time until both tools are within 10 mm of the goal for good; no: they are not at the end",
    "held: ticks in which ours executes the certified stop, or a peer has no solution and stands still",
    "near: nearest monitored pair; |a|: greatest acceleration of a joint [rad/s^2]",
    "rest: RMS of the joints' acceleration in the last 0.5 s",
    "* has no acceleration limit; (!) not all targets can be reached with every distance kept",
    f"gave up: took more than {PATIENCE:g} times the motion's own time; figures are of the share that was done",
    "peers get their targets ahead by speed / gain, since they have no feed-forward",
)
_SOLVER_NOTES = (
    "unsolved: ticks without a solution, in which the certified stop was executed",
    "off DAQP's: largest distance of a tool from where DAQP leads it; near, rest: as above",
)


def bench(
    rounds: Annotated[
        int | None, Option(min=1, help=f"How often each motion runs: {_ROUNDS} by default, 1 with --work.")
    ] = None,
    peers: Annotated[bool, Option(help="Measure also roboplan, mink, pink and embodik, if they are installed.")] = True,
    work: Annotated[bool, Option("--work", help="Run two-armed work motions instead of circle and contact.")] = False,
    motion: Annotated[
        list[str] | None,
        Option(metavar="NAME", help="With --work: run only motions whose names begin so. May be repeated."),
    ] = None,
    solver: Solver = None,
    json: Json = False,
) -> None:
    """Time a tick of the controller with both arms, all pairs and the certificate, and compare public controllers.

    Errors, distances, rest and certified stops are measured too, and compared with our controller in free air. Without
    --work, a second table compares all installed QP solvers in the contact motion. With --solver, it has only DAQP and
    that solver.
    """
    if motion and not work:
        raise ConfigError("--motion needs --work")
    motions = motions_named(motion or WORK_MOTIONS) if work else TIMED_MOTIONS
    names = tuple(PEERS) if peers else ()
    config = with_solver(load_config(DEMO_CONFIG), solver)
    with notice_of_compiling():
        report = run_bench(config, motions, names, rounds or (1 if work else _ROUNDS), print_progress)
    solvers = None if work else run_solvers(config, SOLVERS if solver is None else (solver,), print_progress)
    tables = (bench_table(report), *(() if solvers is None else (solver_table(solvers),)))
    print_report({**asdict(report), "solvers": solvers}, tables, json)


def bench_table(report: BenchReport) -> Table:
    """Return a table with a heading for each motion and, below it, a row for each controller."""
    return figure_table(
        f"{report.cell}: ticks of 1 ms, {report.pairs} pairs, rounds: {report.rounds}",
        (
            *("controller", "p50 [us]", "p99 [us]", "RMS [mm]", "free [mm]", "there [s]"),
            *("held [%]", "near [mm]", "|a| [s-2]", "rest [s-2]"),
        ),
        _bench_rows(report),
        [*(f"{row.motion}: {row.about}" for row in report.rows), *_NOTES, *report.notes],
    )


def solver_table(report: SolverReport) -> Table:
    """Return a table with a row for each solver."""
    return figure_table(
        f"{report.cell}: {report.motion}, ticks of {1e3 * report.dt:g} ms, by QP solver",
        ("solver", "p50 [us]", "p99 [us]", "unsolved [%]", "off DAQP's [mm]", "near [mm]", "rest [s-2]"),
        (
            (
                f"{found.solver}{'' if found.motion.done == 1.0 else f' ({100.0 * found.motion.done:.0f} % done)'}",
                *(found.motion.times_us or (None, None))[:2],
                found.unsolved_percent,
                found.off_daqp_mm,
                found.motion.min_distance_mm,
                found.motion.rest_acceleration,
            )
            for found in report.figures
        ),
        [*_SOLVER_NOTES, *([f"not installed: {', '.join(report.missing)}; {INSTALL}"] if report.missing else ())],
    )


def _bench_rows(report: BenchReport) -> Iterator[tuple[Cell, ...]]:
    for row in report.rows:
        yield (f"{row.motion}{'' if row.reachable else ' (!)'}",)
        for figures in row.figures:
            yield _cells(row, figures)
            if figures.done < 1.0:
                yield (f"  gave up at {100.0 * figures.done:.0f} %",)


def _cells(row: BenchRow, figures: MotionFigures) -> tuple[Cell, ...]:
    held = figures.fallback_percent
    if held is None and figures.ticks:
        held = 100.0 * figures.failures / figures.ticks
    misses = figures.arrival_s is None and row.free_air.arrival_s is not None
    return (
        f"  {figures.controller}{'*' if figures.controller in WITHOUT_ACCELERATION_LIMIT else ''}",
        *(figures.times_us or (None, None))[:2],
        figures.rms_error_mm,
        row.free_air.rms_error_mm if figures is row.figures[0] else "",
        "no" if misses else figures.arrival_s,
        held,
        figures.min_distance_mm,
        figures.max_acceleration,
        figures.rest_acceleration,
    )


def soak(
    cell: ConfigFile = DEMO_CONFIG,
    ticks: Annotated[int, Option(min=100, help="Number of ticks.")] = 1_000_000,
    contact: Annotated[bool, Option("--contact", help="Allow fingers to touch the table and each other.")] = False,
    policy: Annotated[
        bool, Option("--policy", help="Send hostile actions of a policy through the whole pipeline.")
    ] = False,
    seed: Annotated[int, Option(min=0, help="Seed of all random numbers.")] = 0,
    seeds: Annotated[int, Option(min=1, help="Number of soaks, with the seeds from --seed on and --ticks each.")] = 1,
    workers: Workers = 1,
    cluster: ClusterAddress = None,
    solver: Solver = None,
    json: Json = False,
) -> None:
    """Check every promise of a cell's controller under random hostile targets, ticks, starts and solver failures.

    At ticks without a solver failure, the solver that --solver names is used. The worst margin of each promise is
    printed. Exit code 1 if a promise was broken.
    """
    config = with_solver(load_config(cell), solver)
    config = with_contact(config, FINGERS) if contact else config
    place = chosen_place(workers, cluster)
    with notice_of_compiling():
        if seeds > 1 or place is not HERE:
            report = run_soaks(config, ticks, range(seed, seed + seeds), place, policy=policy, progress=print_progress)
        elif policy:
            report = PolicySoak(config, seed).run(ticks, print_progress)
        else:
            report = run_soak(config, ticks, seed, print_progress)
    options = f"{'--policy ' * policy}{'--contact ' * contact}"
    options = f"{'' if cell == DEMO_CONFIG else f'{cell} '}{options}{'' if solver is None else f'--solver {solver} '}"
    table = figure_table(
        f"{report.cell}: {report.ticks} hostile ticks, {report.simulated_s:.0f} s, {_seeds_of(report)}, "
        f"{report.solver}",
        ("promise", "worst", "allowed", "checked", "broken"),
        _soak_rows(report),
        list(_soak_notes(report, options)),
    )
    print_report(report.as_json(), (table,), json)
    raise Exit(0 if report.passed else 1)


def _seeds_of(report: SoakReport) -> str:
    first, last = report.seed, report.seed + report.seeds - 1
    return f"seed {first}" if first == last else f"seeds {first} to {last}"


def _soak_rows(report: SoakReport) -> Iterator[tuple[Cell, ...]]:
    """Yield a row for every promise: its worst margin, and how often it was broken."""
    for margin in report.margins:
        name = Text(margin.name, style="red" if margin.violations else "")
        worst = "" if math.isinf(margin.worst) and not margin.violations else f"{margin.worst:.2g} {margin.unit}"
        yield name, worst, f"{margin.sense} {margin.allowed:.2g}", margin.checked, margin.violations
    if (grown := report.memory_growth_mb) is not None:
        broken = int(grown > MEMORY_ALLOWED)
        yield "steady memory growth after a tenth", f"{grown:.2f} MB", f"<= {MEMORY_ALLOWED:g}", 1, broken


def _soak_notes(report: SoakReport, options: str) -> Iterator[str]:
    """Yield lines below the table: counts, each promise's first violation, and a command.

    The command, which has these ``options``, repeats the earliest violation.
    """
    counted = COUNTED if "resets" in report.counts else POLICY_COUNTED
    yield ", ".join(f"{report.counts[name]} {what}" for name, what in counted.items())
    for found in report.broken:
        error = f": {found.error}" if found.error else ""
        where = f"tick {found.since_segment} of: {found.segment}; dt {found.dt}"
        seed = f" of seed {found.seed}" if report.seeds > 1 else ""
        yield f"first broken at tick {found.tick}{seed}: {found.promise}{error} [{where}]"
    if report.broken:
        again = f"{options}--seed {report.broken[0].seed} --ticks {report.broken[0].tick + 1}"
        yield f"to see the first again: q2r2 soak {again}"
