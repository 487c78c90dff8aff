"""``q2r2 doctor``: report what this computer lacks, and the command that installs or corrects it."""

from __future__ import annotations

import importlib.util
import os
import platform
import socket
import sys
from collections.abc import Iterable, Iterator, Mapping
from importlib.metadata import PackageNotFoundError, requires, version
from typing import Annotated

from packaging.requirements import Requirement
from typer import Argument, Exit

from q2r2_control.cli.output import DEMO_CONFIG, Json, as_json_text
from q2r2_control.cli.ros import print_findings
from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.errors import MissingPackageError
from q2r2_control.extras import install_line
from q2r2_control.inputs.listener import access_lines
from q2r2_control.plugins import INPUTS, PLANTS, load_class
from q2r2_control.process.machine_notes import has_display, machine_notes, network_notes
from q2r2_control.ros.launch.build import interface_packages
from q2r2_control.ros.watching.findings import Finding, error

_PACKAGE = "q2r2_control"

# For each extra: a text on what does not work without its packages. The function _ros examines the extra ros.
_NEEDS_EXTRA = {
    "sim": "no --plant mujoco, no q2r2 demo, no pictures of simulated cameras",
    "data": "no --record, no q2r2 replay, judge, report and export",
    "headset": "no --input headset, no q2r2 headset-check",
    "fri": "no --plant fri",
    "web": "no --web, no --input webxr",
    "export": "no q2r2 export hdf5 and lerobot-v2.1",
    "lerobot": "no q2r2 export lerobot",
    "gym": "no environments of Gymnasium",
    "cluster": "no --cluster",
    "xacro": "no models that end in .xacro",
    "modbus": "no Robotiq grippers by Modbus",
    "cameras": "no cameras with a device",
}


def doctor(
    config: Annotated[str, Argument(metavar="[CONFIG]", help="YAML of the cell.")] = DEMO_CONFIG,
    json: Json = False,
) -> None:
    """Say what this computer lacks to run a cell, and the cure of each fault.

    Exit code 1 if it cannot run the cell. The command examines Python and its packages, ROS, the ports of the cell,
    real-time scheduling, the display, and whether a headset can reach this computer. It changes nothing. With ROS, q2r2
    ros doctor examines the running nodes.
    """
    cell = load_config(config)
    lacking = list(_lacking(cell))
    facts = {
        "python": platform.python_version(),
        "version": version(_PACKAGE),
        "system": platform.platform(terse=True),
        "compiler": "not needed, but by q2r2 ros build-interfaces",
        "headset": "; ".join(access_lines(cell.headset.host, cell.headset.port, cell.headset.networks)),
    }
    if cell.fri:
        facts["cabinets"] = f"q2r2 fri-check {config} says how evenly they send"
    required = requires(_PACKAGE) or ()
    findings = [*lacking, *_packages(required), *_extras(required), *_ros(), *_ports(cell), *_display(os.environ)]
    notes = machine_notes() + network_notes(cabinet.address for cabinet in cell.fri.values())
    findings += [Finding(False, *_what_and_cure(note)) for note in notes]
    lacks = any(finding.stops_arms for finding in findings)
    if json:
        print(as_json_text({**facts, "findings": findings, "lacks": lacks}))
    else:
        print_findings(facts, findings, "missing")
        if findings and not lacks:
            print("nothing is missing for a simulation; the warnings concern real arms, ROS and named extras")
    sys.stdout.flush()
    raise Exit(int(lacks))


def _lacking(cell: Config) -> Iterator[Finding]:
    """Yield a finding if a package of an extra is missing for the input or the plant of the cell."""
    for group, name in ((INPUTS, cell.input), (PLANTS, cell.plant)):
        try:
            load_class(group, name)
        except MissingPackageError as missing:
            yield error(*_what_and_cure(str(missing)))


def _packages(required: Iterable[str]) -> Iterator[Finding]:
    """Yield a finding for each requirement in ``required`` that is not met. Requirements of extras do not count."""
    for requirement, found in _unmet(required):
        what = f"{requirement.name}: {found} is installed; needed: {requirement.specifier}"
        yield error(what, f"{sys.executable} -m pip install '{requirement.name}{requirement.specifier}'")


def _extras(required: Iterable[str]) -> Iterator[Finding]:
    """Yield a finding for each extra that has an unmet requirement in ``required``."""
    required = tuple(required)
    for extra, lacks in _NEEDS_EXTRA.items():
        if names := [requirement.name for requirement, _ in _unmet(required, extra)]:
            yield Finding(False, f"without {', '.join(names)}: {lacks}", install_line(extra))


def _unmet(required: Iterable[str], extra: str = "") -> Iterator[tuple[Requirement, str]]:
    """Yield each unmet requirement of the package, or of its ``extra``, with the installed version or "none"."""
    for requirement in map(Requirement, required):
        marker = requirement.marker
        needed_by = [name for name in ("", extra) if marker is None or marker.evaluate({"extra": name})]
        if needed_by[:1] != [extra]:  # A requirement of the package itself does not count for an extra.
            continue
        try:
            found = version(requirement.name)
        except PackageNotFoundError:
            found = "none"
        if found == "none" or not requirement.specifier.contains(found, prereleases=True):
            yield requirement, found


def _ros() -> Iterator[Finding]:
    """Yield a finding if something is missing for the ROS nodes. All other parts work without ROS."""
    if importlib.util.find_spec("rclpy") is None:
        cure = f"{install_line('ros')}, or source a ROS 2 Jazzy, if you want them"
        yield Finding(False, "rclpy cannot be imported: no ROS nodes", cure)
    elif lacking := [its.name for its in interface_packages() if importlib.util.find_spec(its.name) is None]:
        yield Finding(False, f"no messages of {', '.join(lacking)}: no ROS nodes", "q2r2 ros build-interfaces")


def _ports(cell: Config) -> Iterator[Finding]:
    """Yield a finding for each port of the cell's input and plant on which this computer cannot listen."""
    wanted = [("headset", socket.SOCK_STREAM, cell.headset.host, cell.headset.port)]
    wanted += [(f"fri.{arm}", socket.SOCK_DGRAM, "0.0.0.0", its.port) for arm, its in cell.fri.items()]
    for key, kind, host, port in wanted:
        try:
            with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, kind) as probe:
                if kind == socket.SOCK_STREAM:
                    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind((host, port))
        except OSError as why:
            cure = f"another {key}.port in the YAML, or end the program that `ss -lnp 'sport = :{port}'` names"
            yield error(f"{key}: port {port} of {host} cannot be listened on: {why.strerror}", cure)


def _display(environment: Mapping[str, str]) -> Iterator[Finding]:
    """Yield a finding if there is no display. Only MuJoCo's window needs a display."""
    if not has_display(environment):
        yield Finding(
            False,
            "no display: no --viewer",
            "work at the computer's desktop or by ssh -X; runs without --viewer need no display",
        )


def _what_and_cure(note: str) -> tuple[str, str]:
    """Split a note into the problem and its cure, which follows the last "; ". Commands in notes have no "; "."""
    what, _, cure = note.rpartition("; " if "; " in note else ": ")
    return what, cure
