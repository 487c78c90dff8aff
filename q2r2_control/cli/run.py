"""``q2r2 run``: run a cell with an input and a plant of the user's choice.

``q2r2 demo`` shows simulated assembly work, and ``q2r2 headset-check`` shows the messages of a headset.
"""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console
from typer import Argument, Exit, Option

from q2r2_control.cli.cell_run import RunOptions, print_summary, run_cell
from q2r2_control.cli.evaluate import print_trials
from q2r2_control.cli.output import (
    DEMO_CONFIG,
    Anonymous,
    ClusterAddress,
    ConfigFile,
    Json,
    Operator,
    RealTime,
    Solver,
    Task,
    Verbose,
    Wait,
    WebHost,
    WebPort,
    longest_wait,
    notes_of,
    notice_of_compiling,
    positive,
    print_progress,
    print_report,
    say,
    with_solver,
)
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.resources import find_resource
from q2r2_control.demo.assembly_tasks import (
    ALL_TASKS,
    TASKS,
    AssemblyTask,
    held_to_promises,
    tasks_named,
    with_controls,
    with_parts_at,
)
from q2r2_control.demo.trials import try_task, try_tasks
from q2r2_control.errors import NOT_RECORDED, ConfigError, InputError
from q2r2_control.extras import install_line, require
from q2r2_control.inputs.base import adapted, make_input, options_of
from q2r2_control.inputs.scripted import TRAJECTORIES, hurried, place_of, trajectory_named
from q2r2_control.plugins import PLANTS, load_class
from q2r2_control.process.places import JobPlace, Processes, chosen_place
from q2r2_control.process.scheduling import StopRequest, stop_on_signals
from q2r2_control.robot.commissioned import drives_real_arms, not_commissioned, slowed
from q2r2_control.teleop.crossed_hands import CrossedHands
from q2r2_control.types import CommandMode

LARGEST_SPREAD = 0.03  # Largest displacement of the parts at which the arms still reach the parts in all tasks [m].
_PORT = 8080  # The port of the page, unless an option names another port.
_FRI_CONFIG = "config/dual_iiwa7_fri.yaml"
_TASKS = f"[{'|'.join((*TASKS, ALL_TASKS))}]..."
_ABOUT = "; ".join(f"{task.name}: {task.about}" for task in TASKS.values())

Fast = Annotated[bool, Option("--fast", help="Use simulated time, as fast as possible. Results are repeatable.")]
Headless = Annotated[bool, Option("--headless", help="Show no live table and no window.")]
Viewer = Annotated[bool, Option("--viewer", help="Open MuJoCo's window; closing it ends the run.")]
Human = Annotated[bool, Option("--human", help="Let scripted hands tremble, and samples be lost or late.")]
Seed = Annotated[int, Option(min=0, help="Seed of the random numbers of --human.")]
Record = Annotated[Path | None, Option(metavar="DIR", help="Record the run to a new folder in DIR.")]
Web = Annotated[bool, Option("--web", help="Show the run at http://127.0.0.1:8080; needs the extra `web`.")]

Host = Annotated[str | None, Option(help="Address to bind, instead of the config's; 0.0.0.0: all, :: IPv6 too.")]
Port = Annotated[int | None, Option(min=0, max=65535, help="Port, instead of the config's; 0: any free port.")]
Usb = Annotated[bool, Option("--usb", help="webxr: the headset is on a USB cable; its page is http://localhost:8443.")]
Certificate = Annotated[Path | None, Option(metavar="FILE", help="webxr: PEM file with your certificate and its key.")]


def run(
    config: ConfigFile,
    input: Annotated[str | None, Option(metavar="NAME", help="An installed input; by default the cell's.")] = None,
    plant: Annotated[str | None, Option(metavar="NAME", help="An installed plant; by default the cell's.")] = None,
    mode: Annotated[
        CommandMode, Option(help="Commands to the plant. With torque, arms yield when they are pushed.")
    ] = (CommandMode.POSITION),
    duration: Annotated[float | None, Option(help="Duration [s]; by default until Ctrl-C.")] = None,
    fast: Fast = False,
    trajectory: Annotated[str | None, Option(help=f"With --input scripted: {', '.join(TRAJECTORIES)}.")] = None,
    human: Human = False,
    seed: Seed = 0,
    policy: Annotated[str | None, Option(metavar="MODULE:NAME", help="With --input policy: the policy.")] = None,
    takeover: Annotated[
        str | None, Option(metavar="NAME", help="With --input policy: input whose hands may take over.")
    ] = None,
    recording: Annotated[
        str | None, Option(metavar="FILE", help="With --input recording: the recording whose hands move the arms.")
    ] = None,
    solver: Solver = None,
    host: Host = None,
    port: Port = None,
    usb: Usb = False,
    certificate: Certificate = None,
    viewer: Viewer = False,
    headless: Headless = False,
    web: Web = False,
    web_host: WebHost = "127.0.0.1",
    web_port: WebPort = _PORT,
    rt: RealTime = False,
    record: Record = None,
    task: Task = None,
    operator: Operator = None,
    anonymous: Anonymous = False,
    force: Annotated[bool, Option("--force", help="Run even if q2r2 check finds a fault.")] = False,
    i_know: Annotated[bool, Option("--i-know", help="Run real cabinets that are not commissioned.")] = False,
    full_speed: Annotated[
        bool, Option("--full-speed", help="Move real arms at full speed, not a tenth of it.")
    ] = False,
    wait: Wait = None,
    verbose: Verbose = False,
    json: Json = False,
) -> None:
    """Run a cell until the duration is over or until Ctrl-C, and bring the arms to rest at the end.

    A cell in which q2r2 check finds a fault is refused with the same lines and exit code 2, unless --force is given. A
    cell with real cabinets that is not commissioned is refused too, unless --i-know is given. The joints of real
    arms move at a tenth of their speed, unless --full-speed is given.
    Exit code 1 if a tool is more than 100 mm from its reference at the end, if an arm refused every press that engages
    it, if measured links met in torque mode, if a tick had no certificate, if a policy raised an error or gave actions
    that cannot be used, or if an arm still moves at the end. Exit code 3 if there is no such fault, but the recording
    ended before the run, as with a full disk or a killed writer.
    With the headset, one line on stderr says which address was bound: "headset: listening on HOST:PORT".
    """
    cell = with_solver(load_config(config), solver)
    if (plant or cell.plant) == "fri" and not i_know and (why := not_commissioned(cell, find_resource(config))):
        raise ConfigError(f"{config}: {why}; q2r2 commission {config} commissions it; --i-know runs it all the same")
    if not full_speed and drives_real_arms(cell, plant or cell.plant):
        cell = slowed(cell)
        say("real arms: joints at a tenth of their speed; --full-speed ends that", style="yellow")
    source = input or cell.input
    for name in filter(None, (source, takeover)):
        cell = adapted(name, cell)
    web |= "web" in (source, takeover)
    asked: dict[str, object] = {"trajectory": trajectory, "host": host, "port": port}
    asked |= {"usb": usb or None, "certificate": certificate}
    asked |= {"policy": policy, "takeover": takeover, "recording": recording}
    asked |= {"human": human or None, "seed": seed or None, "fast": fast or None}
    given = {option: value for option, value in asked.items() if value is not None}
    if unfit := [option for option in given if option not in options_of(source)]:
        cures = {"policy": "policy", "takeover": "policy", "recording": "recording"}
        cure = f"; add --input {cures[unfit[0]]}" if unfit[0] in cures else ""
        usual = "" if input is not None else ", which is the cell's input"
        raise ConfigError(f"--{unfit[0]} cannot be used with --input {source}{usual}{cure}")
    if fast and duration is None:
        raise ConfigError("--fast needs --duration, since simulated time has no end of its own")
    _check_times(fast, rt, plant or cell.plant)
    if wait is not None and not hasattr(load_class(PLANTS, plant or cell.plant), "longest_wait"):
        raise ConfigError(f"--wait cannot be used with --plant {plant or cell.plant}, which waits for nobody")
    options = RunOptions(
        name=cell.name,
        input=source,
        plant=plant or cell.plant,
        mode=mode.value,
        duration=positive("--duration", duration),
        fast=fast,
        input_options=given,
        table=_shows_table(headless, viewer),
        window=viewer,
        page=(web_host, web_port, certificate) if web else None,
        force=force,
        real_time=rt,
        record=record,
        anonymous=anonymous,
        notes=notes_of(task, operator, record, anonymous),
        longest_wait=longest_wait(wait),
    )
    try:
        done = run_cell(cell, options)
    # With --fast, the policy runs in this thread. If it called sys.exit(0), the command would end with exit code 0.
    except SystemExit as error:
        raise InputError(f"the run was ended by SystemExit({error.code}); allowed: a policy that returns") from error
    print_summary(done, json, verbose)
    if done.summary.broken:
        raise Exit(1)
    if not done.was_recorded:
        raise Exit(NOT_RECORDED)


def demo(
    tasks: Annotated[
        list[str] | None, Argument(metavar=_TASKS, help=f"Tasks in their order; by default handover stack. {_ABOUT}.")
    ] = None,
    mode: Annotated[
        CommandMode | None,
        Option(help="Commands to the arms; by default torque, so that the arms yield, but position with --plant fri."),
    ] = None,
    plant: Annotated[str, Option(metavar="[mujoco|fri]", help="fri: arms behind two simulated KUKA cabinets.")] = (
        "mujoco"
    ),
    period: Annotated[
        float, Option(min=1, max=10, help="With --plant fri: time between two messages of a cabinet [ms].")
    ] = 10.0,
    duration: Annotated[
        float | None, Option(help="End the run after this time [s], if the tasks are not over before.")
    ] = None,
    fast: Fast = False,
    viewer: Viewer = False,
    headless: Headless = False,
    web: Web = False,
    web_host: WebHost = "127.0.0.1",
    web_port: Annotated[
        int | None,
        Option(min=0, max=65535, metavar="PORT", help=f"Port of the page; 0: any free one; by default {_PORT}."),
    ] = None,
    human: Human = False,
    hands: Annotated[
        str | None,
        Option(
            metavar="[careful|shaky]",
            help="careful: same as --human; shaky: faster, 2 mm of tremor, lost for a second.",
        ),
    ] = None,
    seed: Seed = 0,
    seeds: Annotated[
        int | None,
        Option(min=1, help="Try each task this many times with --human in simulated time, and count successes."),
    ] = None,
    cluster: ClusterAddress = None,
    spread: Annotated[
        float, Option(min=0, max=LARGEST_SPREAD, help="Largest displacement of the parts, which --seed draws [m].")
    ] = 0.0,
    record: Record = None,
    anonymous: Anonymous = False,
    rt: RealTime = False,
    solver: Solver = None,
    verbose: Verbose = False,
    json: Json = False,
) -> None:
    """Let two simulated arms hand a bar to each other and stack blocks, driven only by samples of scripted hands.

    At a terminal, the arms are shown in MuJoCo's window, or in a browser if there is no display. With --plant fri, all
    processes have real-time priority as with --rt, if that is permitted, because cabinets do not wait for a busy
    computer.
    The summary has a line for each task, with the result that the simulation measured. Exit code 1 if a task failed.
    With --record, the recording says whether all tasks succeeded, and q2r2 report makes plots of it. Exit code 3 if the
    recording ended before the run. With --seeds, exit code 1 if a task succeeded in less than 19 of 20 trials.
    """
    if plant not in ("mujoco", "fri"):
        raise ConfigError(f"--plant {plant!r:.40}: allowed: mujoco, fri")
    require("sim", "q2r2 demo")
    _check_times(fast, rt, plant)
    if hands not in (None, "careful", "shaky"):
        raise ConfigError(f"--hands {hands!r:.40}: allowed: careful, shaky")
    shaky = hands == "shaky"
    mode = mode or (CommandMode.POSITION if plant == "fri" else CommandMode.TORQUE)
    chosen = tasks_named(tasks or ("handover", "stack"))
    if seeds is not None:
        unfit = {"--plant fri": plant == "fri", "--viewer": viewer, "--record": record is not None, "--rt": rt}
        unfit |= {"--duration": duration is not None, "--seed": seed != 0, "--spread": spread != 0.0}
        if refused := [option for option, given in unfit.items() if given]:
            raise ConfigError(f"{refused[0]} cannot be used with --seeds")
        trials_at = Processes(os.cpu_count() or 1) if cluster is None else chosen_place(1, cluster)
        _try_tasks(chosen, mode, seeds, trials_at, shaky, solver, json)
        return
    if cluster is not None:
        raise ConfigError("--cluster needs --seeds")
    if spread and plant == "fri":
        raise ConfigError("--spread cannot be used with --plant fri, whose parts lie where its cell has them")
    trajectory, place = "+".join(task.name for task in chosen), place_of(seed, spread)
    work = trajectory_named(trajectory, place)
    work = hurried(work, seed) if shaky else work
    table = _shows_table(headless, viewer)
    usual_port, unseen = _PORT, ""
    if table and plant == "mujoco" and not (viewer or web or fast):
        from q2r2_control.plants.mujoco_cameras import window_fault  # The import is here, because run needs no MuJoCo.

        viewer = window_fault() is None
        # Another program may already use the usual port. Port 0 therefore stands for any free port.
        web, usual_port = not viewer and find_spec("viser") is not None, 0
        if not (viewer or web):
            unseen = f"no display: to see the arms in a browser, type {install_line('web')}"
            say(unseen)
    given: dict[str, object] = {"trajectory": trajectory, "human": human or hands is not None, "seed": seed}
    given |= {"shaky": shaky, "spread": spread}
    options = RunOptions(
        name="demo",
        input="scripted",
        plant=plant,
        mode=mode.value,
        duration=min((time for time in (positive("--duration", duration), work.duration) if time), default=None),
        fast=fast,
        input_options=given,
        table=table,
        window=viewer,
        page=(web_host, usual_port if web_port is None else web_port, None) if web else None,
        real_time=rt or plant == "fri",  # Cabinets do not wait for the late answers of a busy computer.
        tasks=chosen,
        steps=work.steps,
        record=record,
        anonymous=anonymous,
        notes=notes_of(None, None, record, anonymous) | {"task": "; ".join(task.about for task in chosen)},
    )
    if plant == "fri":
        # The import is here, because only this demo needs the simulated cabinets.
        from q2r2_control.cli.fri import rehearsal

        with rehearsal(_FRI_CONFIG, mode, chosen, period, rt=True) as results:
            done = run_cell(with_solver(with_controls(load_config(_FRI_CONFIG)), solver), options)
        done = replace(done, tasks=held_to_promises(results, done.summary))
    else:
        cell = with_parts_at(with_controls(load_config(DEMO_CONFIG)), chosen, place)
        done = run_cell(with_solver(cell, solver), options)
    print_summary(done, json, verbose)
    # This line is printed again, because the compilation of kernels may have taken a minute since the first time.
    if unseen:
        say(unseen)
    if not all(task.succeeded for task in done.tasks):
        raise Exit(1)
    if not done.was_recorded:
        raise Exit(NOT_RECORDED)


def _try_tasks(
    tasks: tuple[AssemblyTask, ...],
    mode: CommandMode,
    seeds: int,
    place: JobPlace,
    shaky: bool,
    solver: str | None,
    json: bool,
) -> None:
    with notice_of_compiling():
        config = with_solver(load_config(DEMO_CONFIG), solver)
        reports = try_tasks(tasks, partial(try_task, config, mode, shaky), seeds, place, print_progress)
    print_trials(reports, json)
    if not all(report.is_reliable for report in reports):
        raise Exit(1)


def _check_times(fast: bool, rt: bool, plant: str) -> None:
    if fast and rt:
        raise ConfigError("--rt and --fast exclude each other, since simulated time is never late")
    if fast and getattr(load_class(PLANTS, plant), "realtime_only", False):
        raise ConfigError(f"--fast cannot be used with --plant {plant}, which keeps real time")


def _shows_table(headless: bool, viewer: bool) -> bool:
    if headless and viewer:
        raise ConfigError("--headless and --viewer exclude each other")
    return not headless and sys.stderr.isatty()


def headset_check(
    config: Annotated[str, Argument(metavar="[CONFIG]", help="Cell whose address and teleop.axes are used.")] = (
        DEMO_CONFIG
    ),
    input: Annotated[
        str, Option(metavar="[headset|webxr]", help="headset: Quest2ROS; webxr: a page in the headset's browser.")
    ] = "headset",
    host: Host = None,
    port: Port = None,
    usb: Usb = False,
    certificate: Certificate = None,
    duration: Annotated[float | None, Option(help="Duration [s]; by default until Ctrl-C.")] = None,
    json: Json = False,
) -> None:
    """Show what a headset sends: connection, rates, ages, last values, and which way each hand moves.

    Move a hand forwards, to the left, and up. If the printed directions differ, change teleop.axes in the config.
    Exit code 1 if poses or inputs of a hand that leads an arm did not come. Without them, the arm cannot be engaged.
    """
    # The imports are here, because run and demo do not need the packages of these modules.
    from q2r2_control.inputs.headset_check import watch_headset
    from q2r2_control.viewer.headset_table import headset_display, headset_table

    console, stop = Console(stderr=True), StopRequest()
    positive("--duration", duration)
    if input not in ("headset", "webxr"):
        raise ConfigError(f"--input {input!r:.40}: allowed: headset, webxr")
    if input == "headset" and (usb or certificate is not None):
        raise ConfigError(f"{'--usb' if usb else '--certificate'} cannot be used with --input headset")
    cell = adapted(input, load_config(config))
    options = {"host": host, "port": port, "usb": usb, "certificate": certificate, "say": partial(say, console=console)}
    server: Any = make_input(input, cell, **options)
    # Signals are caught before the server announces its address. A KeyboardInterrupt in a finaliser would be lost.
    with stop_on_signals(stop.ask):
        server.start()
        try:
            with headset_display(console) as show:
                watch = CrossedHands(cell.teleop.axes)
                check = watch_headset(server, cell, duration, show, lambda: stop.asked, watch)
        finally:
            server.close()
    print_report(check.as_json(), (headset_table(check),), json)
    raise Exit(1 if check.missing else 0)
