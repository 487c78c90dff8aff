"""``q2r2 bench``: figures of this machine, from real ticks and real nodes."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Annotated, NoReturn

import typer
from rich.console import Console

from q2r2_control.benchmark.feel_run import run_feel
from q2r2_control.benchmark.loop_times import LoopReport, run_loop_bench
from q2r2_control.benchmark.peers.base import PEERS
from q2r2_control.benchmark.press_run import PRESSES, run_press
from q2r2_control.benchmark.rest_run import RestReport, run_rest
from q2r2_control.benchmark.stack_bench import StackReport, run_stack_bench
from q2r2_control.benchmark.tick_times import run_bench
from q2r2_control.benchmark.work_bench import WORK_PEERS, run_work_bench
from q2r2_control.cli.feel_table import show_feel
from q2r2_control.cli.loop_table import loop_table
from q2r2_control.cli.options import DEMO_CONFIG, Json
from q2r2_control.cli.output import as_json_text, notice_of_compiling, stderr_console
from q2r2_control.cli.press_table import press_table
from q2r2_control.cli.rest_table import rest_table
from q2r2_control.cli.ros_table import latency_table, load_table, presses_table
from q2r2_control.cli.soak_table import soak_table
from q2r2_control.cli.stack_table import following_table, safety_table
from q2r2_control.cli.times_table import motion_table, times_table
from q2r2_control.cli.work_table import work_table
from q2r2_control.config.cameras import CameraConfig
from q2r2_control.config.cell import Config, load_config
from q2r2_control.errors import ConfigError
from q2r2_control.types import CommandMode
from q2r2_control.verification.contact_cells import FINGERS, TABLE_ONLY, with_contact
from q2r2_control.verification.soak import SoakReport, run_soak
from q2r2_control.verification.work_motions import WORK_MOTIONS, WorkMotion, motions_named

_TICKS, _SOAK_TICKS, _SECONDS = 3000, 1_000_000, 30.0
_CAMERA = CameraConfig(position=(1.9, 0.0, 1.0), look_at=(0.4, 0.0, 0.3), width=320, height=240, rate=10.0)
_STARTS = 3  # of the set of nodes, for presses; fewer in a short bench
_RATE = 250.0  # of the controller's node by default [Hz]


def bench(
    ticks: Annotated[
        int | None, typer.Option(min=100, help=f"Of each scenario, {_TICKS} by default; of a soak {_SOAK_TICKS}.")
    ] = None,
    peers: Annotated[bool, typer.Option(help="Time roboplan, mink and pink too, where they are installed.")] = True,
    work: Annotated[
        bool, typer.Option("--work", help="Measure two-armed work motions: errors, distances, rest, times.")
    ] = False,
    motion: Annotated[
        list[str] | None,
        typer.Option(help="With --work: only this motion, or those that begin with it, such as carry; repeatable."),
    ] = None,
    through: Annotated[
        list[CommandMode] | None,
        typer.Option(help="With --work: from hand samples through the whole stack to MuJoCo, so driven; repeatable."),
    ] = None,
    soak: Annotated[
        bool, typer.Option("--soak", help="Check every promise in hostile ticks instead of timing.")
    ] = False,
    contact: Annotated[
        bool,
        typer.Option("--contact", help="With --soak: fingers may touch table and fingers, as in torque mode."),
    ] = False,
    rest: Annotated[
        bool, typer.Option("--rest", help="Ask for constant targets, most out of reach: do the arms come to rest?")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of the soak, of --rest, or of the hands with --through.")] = 0,
    loop: Annotated[bool, typer.Option("--loop", help="Time the whole live loop instead, stage by stage.")] = False,
    record: Annotated[bool, typer.Option("--record", help="With --loop: also while the run is recorded.")] = False,
    camera: Annotated[
        bool, typer.Option("--camera", help="With --record: with pictures of MuJoCo, 320x240, ten a second.")
    ] = False,
    press: Annotated[
        bool, typer.Option("--press", help="Press a finger on the table in torque mode: forces in MuJoCo.")
    ] = False,
    feel: Annotated[
        bool, typer.Option("--feel", help="Measure delay, tremor, noise and stops from the hand to the tool.")
    ] = False,
    ros: Annotated[bool, typer.Option("--ros", help="Time the ROS nodes instead.")] = False,
    duration: Annotated[
        float | None, typer.Option(min=1, max=3600, help=f"Of each input, {_SECONDS:g} by default; with --ros [s].")
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(min=20, max=1000, help=f"Of the controller's node, {_RATE:g} by default; with --ros [Hz]."),
    ] = None,
    json: Json = False,
) -> None:
    """Time one tick of the controller with both arms, every pair and the certificate, and public peers beside it.

    With --work: both arms at work near each other and near the table, beside ours in free air, roboplan and mink. With
    --through as well: ours alone, driven by hand samples, with arms in MuJoCo; every promise of the controller is
    checked at every tick. Exit 1 if one was broken, or if a motion did not come to its end.

    With --soak: random hostile targets, ticks, starts and solver failures; every promise of the controller is checked
    at every tick, and the worst margin of each is printed. Exit 1 if one was broken.

    With --rest: targets drawn at random that stay, near both arms and on the other arm's side. How quiet the arms are
    at the end, and how smoothly they got there.

    With --loop: where a tick of q2r2 run goes, from inputs to recording, for three plants and modes.

    With --press: what the table feels of a finger that is commanded into it, and slides. Exit 1 if a promise is broken.

    With --feel: a hand moves in tones, trembles, rests and stops; for the cell's filter, one for precision and one for
    speed. Delays and gains from the hand to the measured tool.

    With --ros: the time from a message on an input topic to the joint command that answers it, what follows the first
    press and later ones, what each node takes of the processors, and how evenly the commands move; through real nodes
    on this machine, in a domain of their own.
    """
    if sum((work, soak, rest, ros, loop, press, feel)) > 1:
        raise ConfigError("--work, --soak, --rest, --ros, --loop, --press and --feel exclude each other")
    for option, given in (("--motion", motion), ("--through", through)):
        if given and not work:
            raise ConfigError(f"{option} needs --work")
    if work and ticks is not None:
        raise ConfigError("--ticks cannot be used with --work, whose motions have a length of their own")
    if (press or feel or rest) and ticks is not None:
        raise ConfigError("--ticks cannot be used with --press, --feel and --rest, which have a length of their own")
    if record and not loop:
        raise ConfigError("--record needs --loop")
    if camera and not record:
        raise ConfigError("--camera needs --record")
    if contact and not soak:
        raise ConfigError("--contact needs --soak")
    if seed and not (soak or rest or through):
        raise ConfigError("--seed needs --soak, --rest or --through, since nothing else draws")
    if ros and ticks is not None:
        raise ConfigError("--ticks cannot be used with --ros, which takes --duration")
    if not ros and (duration is not None or rate is not None):
        raise ConfigError("--duration and --rate need --ros")
    motions = motions_named(WORK_MOTIONS if motion is None else motion)
    console = stderr_console()
    if ros:
        _show_ros(_SECONDS if duration is None else duration, rate or _RATE, console, json)
        return
    with notice_of_compiling(console):
        if soak:
            soak_ticks = _SOAK_TICKS if ticks is None else ticks
            cell = load_config(DEMO_CONFIG)
            cell = with_contact(cell, FINGERS) if contact else cell
            _show_soak(run_soak(cell, soak_ticks, seed, _progress(console)), json)
        elif rest:
            _show_rest(run_rest(load_config(DEMO_CONFIG), seed, _progress(console)), json)
        elif through:
            modes = tuple(dict.fromkeys(through))
            _show_stack(run_stack_bench(load_config(DEMO_CONFIG), motions, modes, seed, _progress(console)), json)
        elif work:
            _show_work(motions, WORK_PEERS if peers else (), console, json)
        elif press:
            _show_press(with_contact(load_config(DEMO_CONFIG), TABLE_ONLY), json)
        elif feel:
            cell = load_config(DEMO_CONFIG)
            show_feel(cell.name, run_feel(cell, _progress(console)), json)
        elif loop:
            loop_ticks = _TICKS if ticks is None else ticks
            cell = load_config(DEMO_CONFIG)
            if camera:
                cell = cell.model_copy(update={"cameras": {"front": _CAMERA}})
            _show_loop(run_loop_bench(cell, loop_ticks, _progress(console), record=record), json)
        else:
            _show_times(_TICKS if ticks is None else ticks, tuple(PEERS) if peers else (), console, json)


def _show_times(ticks: int, peers: tuple[str, ...], console: Console, json: bool) -> None:
    report = run_bench(load_config(DEMO_CONFIG), ticks, peers, _progress(console))
    if json:
        print(as_json_text(report.as_json()))
    else:
        out = Console()
        out.print(times_table(report))
        out.print(motion_table(report))


def _show_work(motions: Sequence[WorkMotion], peers: tuple[str, ...], console: Console, json: bool) -> None:
    report = run_work_bench(load_config(DEMO_CONFIG), motions, peers, _progress(console))
    if json:
        print(as_json_text(report.as_json()))
    else:
        Console().print(work_table(report))


def _show_press(config: Config, json: bool) -> NoReturn:
    figures = [run_press(config, *press) for press in PRESSES]
    if json:
        print(as_json_text({"cell": config.name, "presses": [asdict(press) for press in figures]}))
    else:
        Console().print(press_table(config.name, figures))
    raise typer.Exit(1 if any(press.violations for press in figures) else 0)


def _show_rest(report: RestReport, json: bool) -> None:
    if json:
        print(as_json_text(report.as_json()))
    else:
        Console().print(rest_table(report))


def _show_stack(report: StackReport, json: bool) -> NoReturn:
    if json:
        print(as_json_text(report.as_json()))
    else:
        out = Console()
        out.print(following_table(report))
        out.print(safety_table(report))
    raise typer.Exit(0 if report.passed else 1)


def _show_loop(report: LoopReport, json: bool) -> None:
    if json:
        print(as_json_text(report.as_json()))
    else:
        Console().print(loop_table(report))


def _show_soak(report: SoakReport, json: bool) -> NoReturn:
    if json:
        print(as_json_text(report.as_json()))
    else:
        Console().print(soak_table(report))
    raise typer.Exit(0 if report.passed else 1)


def _show_ros(duration: float, rate: float, console: Console, json: bool) -> None:
    missing = [name for name in ("rclpy", "quest2ros", "domain_coordinator") if importlib.util.find_spec(name) is None]
    if missing:
        raise ConfigError(
            f"--ros: {', '.join(missing)} cannot be imported: pip install 'q2r2_control[ros]' and "
            "q2r2 ros build-interfaces, or source a ROS 2 Jazzy"
        )
    # All else works without ROS.
    from q2r2_control.benchmark.ros_latency import measure_latency
    from q2r2_control.benchmark.ros_load import measure_load
    from q2r2_control.benchmark.ros_press import measure_presses

    # Each table as soon as it is measured: what fails later takes nothing away.
    out = Console(quiet=json)
    latency = measure_latency(DEMO_CONFIG, duration, rate, _progress(console))
    out.print(latency_table(latency))
    presses = measure_presses(DEMO_CONFIG, _starts(duration), _progress(console))
    out.print(presses_table(presses))
    load = measure_load(DEMO_CONFIG, duration, _progress(console))
    out.print(load_table(load))
    if json:
        print(as_json_text(latency.as_json() | {"presses": presses.as_json(), "load": load.as_json()}))


def _starts(duration: float) -> int:
    """How often nodes are started for a first press: about as long as the rest of a bench of ``duration`` [s] takes."""
    return max(1, min(_STARTS, round(duration / 10.0)))


def _progress(console: Console) -> Callable[[str], None]:
    """Prints lines, on a terminal only; a live line would need a thread, which would add to the times."""
    if not console.is_terminal:
        return lambda what: None
    return lambda what: console.print(what, highlight=False)
