"""``q2r2 mounts``: find the position of the right arm's base from points that both tips touch."""

from __future__ import annotations

import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pinocchio as pin
from rich.console import Console
from rich.table import Table
from typer import Option

from q2r2_control.cli.output import ConfigFile, Json, Wait, longest_wait, print_report, say
from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.errors import ConfigError, PlantError
from q2r2_control.plants.fri.plant import FriPlant
from q2r2_control.robot.mounts import fit_move
from q2r2_control.robot.robot import Robot
from q2r2_control.types import SIDES, Array
from q2r2_control.viewer.tables import figure_table
from q2r2_control.wording import sentence

Tip = Annotated[tuple[float, float, float], Option(help="Point of each tool that touches, in the tool's frame [m].")]
_FEWEST = 3  # Least number of points that both tips have to touch.
_MOST_APART = 5.0  # Largest allowed distance, after the fit, between two tips that touched the same point [mm].
_BEYOND = 0.1  # A written joint position farther beyond its limits than this is probably not in radians [rad].
_STILL, _LISTENS = 2e-3, 0.5  # Joints at rest move less than this angle [rad] in this time [s].


@dataclass(frozen=True, slots=True)
class MountReport:
    """The mount of the right arm that fits best, and the errors of the fit."""

    position: list[float]  # Position of the mount in the world frame [m].
    rpy: list[float]  # Roll, pitch and yaw of the mount in the world frame [rad].
    moved_mm: float  # Distance between this mount and the mount in the cell.
    turned_deg: float  # Angle between this mount and the mount in the cell.
    off_mm: list[float]  # Distance between the two tips at each touched point, after the fit.

    @property
    def fault(self) -> str | None:
        """The reason why this mount must not be used; None if it may be used."""
        if (worst := max(self.off_mm)) <= _MOST_APART:
            return None
        cure = "see to --tip, and touch points that do not move"
        return f"the tips are {worst:.1f} mm apart; allowed: {_MOST_APART:g} mm; {cure}"

    def table(self) -> Table:
        """Return a table of the distances between the tips, with the lines for the YAML if the mount fits."""
        rows = [(f"point {number}", off) for number, off in enumerate(self.off_mm, 1)]
        notes = [
            f"the right arm's base is {self.moved_mm:.1f} mm and {self.turned_deg:.2f} deg from where the cell has it"
        ]
        if self.fault is None:
            notes += ["arms.right.mount:", f"  position: {self.position}", f"  rpy: {self.rpy}"]
        table = figure_table("tips, after the fit", ("", "apart [mm]"), rows, notes)
        table.min_width = max(map(len, notes))  # Lines to paste must not be wrapped.
        return table


def mount_report(config: Config, points: Array, touched: Array) -> MountReport:
    """Find the mount of the right arm with which both tips touched the same points, as nearly as possible.

    Args:
        config: The cell, with the mounts that were used to compute the positions.
        points: Positions of the left tip in the world frame of the cell (n, 3) [m].
        touched: Positions of the right tip at the same points, in the same frame (n, 3) [m].
    """
    move, off = fit_move(points, touched)
    before = next(arm.mount for side, arm in config.arms.items() if side == SIDES[1])
    mount = pin.SE3(pin.rpy.rpyToMatrix(*before.rpy), np.array(before.position))
    after = move * mount
    return MountReport(
        position=after.translation.round(5).tolist(),
        rpy=pin.rpy.matrixToRpy(after.rotation).round(5).tolist(),
        moved_mm=1e3 * float(np.linalg.norm(after.translation - mount.translation)),
        turned_deg=float(np.degrees(np.linalg.norm(pin.log3(move.rotation)))),
        off_mm=(1e3 * off).round(2).tolist(),
    )


def mounts(
    config: ConfigFile,
    postures: Annotated[
        Path | None,
        Option(metavar="FILE", help="File instead of KUKA's cabinets: a line per point, joints left, right [rad]."),
    ] = None,
    points: Annotated[
        int | None,
        Option(min=_FEWEST, max=20, help="Number of points to touch, far apart and not on a line.  [default: 3]"),
    ] = None,
    tip: Tip = (0.0, 0.0, 0.0),
    wait: Wait = None,
    json: Json = False,
) -> None:
    """Find where the right arm's base is: guide both tips by hand to the same points, one after the other.

    KUKA's cabinets send the joints of the arms. With other arms, write down the joints of both arms at each point. The
    left arm's mount is assumed to be correct. Lines for the YAML are printed; no file is written.
    """
    cell, console = load_config(config), Console(stderr=True)
    robot = Robot.from_config(cell)
    if set(robot.arms) != set(SIDES):
        raise ConfigError(f"{config}: arms: {', '.join(robot.arms)}; allowed: left and right")
    if postures is not None:
        if points is not None:
            raise ConfigError("--points: allowed without --postures, whose file has a line a point")
        touched = _written(postures, robot)
        tips = [np.array([robot.tool_pose(q, arm).act(np.array(tip)) for q in touched]) for arm in SIDES]
        _print(mount_report(cell, *tips), json)
        return
    if not cell.fri:
        raise ConfigError(
            f"{config}: fri: missing; allowed: each arm's cabinet, as {{port: 30200}}, or --postures FILE"
        )
    plant = FriPlant(robot, cell)
    plant.longest_wait = longest_wait(wait)
    try:
        plant.reset()
        report = measure_mount(plant, cell, robot, points or _FEWEST, np.array(tip), console)
    finally:
        plant.close()
    _print(report, json)


def _print(report: MountReport, json: bool) -> None:
    """Print the report; raises :class:`PlantError` if the tips did not touch the same points."""
    print_report(asdict(report), (report.table(),), json)
    if report.fault is not None:
        raise PlantError(report.fault)


def measure_mount(
    plant: FriPlant, config: Config, robot: Robot, points: int, tip: Array, console: Console
) -> MountReport:
    """Let the operator touch a number of ``points`` with both tips, and fit the right arm's mount.

    ``tip`` (3,) is the position of the tip in each tool's frame [m].
    """
    tips: dict[str, list[Array]] = {arm: [] for arm in SIDES}
    for number in range(1, points + 1):
        for arm in SIDES:
            say(f"point {number} of {points}: guide the {arm} tip there, hold it still, and press Enter", console)
            tips[arm].append(robot.tool_pose(_resting(plant, arm, robot, console), arm).act(tip))
    return mount_report(config, *(np.array(tips[arm]) for arm in SIDES))


def _written(file: Path, robot: Robot) -> Array:
    """Read the postures (n, nv) [rad] from a text file. Raises :class:`ConfigError` if the file is not usable."""
    joints = np.concatenate([robot.arms[arm].joints for arm in SIDES])
    allowed = f"lines of {len(joints)} numbers in radians: {', '.join(robot.joint_names[joint] for joint in joints)}"
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else "not a text in UTF-8"
        raise ConfigError(f"--postures {file}: {why}; allowed: a file with {allowed}") from error
    postures_read = []
    for number, line in enumerate(lines, 1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            postures_read.append([float(word) for word in words])
        except ValueError as error:
            raise ConfigError(f"--postures {file}: line {number}: {error}; allowed: {allowed}") from error
        if len(words) != len(joints):
            raise ConfigError(f"--postures {file}: line {number} has {len(words)} numbers; allowed: {allowed}")
    values = np.array(postures_read)
    if values.ndim != 2 or values.shape[1] != len(joints) or not np.isfinite(values).all():
        raise ConfigError(f"--postures {file}: allowed: {allowed}")
    if len(values) < _FEWEST:
        raise ConfigError(f"--postures {file}: {len(values)} points; allowed: {_FEWEST} or more")
    beyond = np.maximum(robot.position_lower[joints] - values, values - robot.position_upper[joints])
    point, worst = np.unravel_index(beyond.argmax(), beyond.shape)
    if beyond[point, worst] > _BEYOND:
        joint = joints[worst]
        limits = f"{robot.position_lower[joint]:.2f} .. {robot.position_upper[joint]:.2f} rad"
        value = f"{robot.joint_names[joint]} = {values[point, worst]:g}"
        raise ConfigError(f"--postures {file}: point {point + 1}: {value}; allowed: {limits}")
    postures = np.zeros((len(values), robot.model.nv))
    postures[:, joints] = values
    return postures


def _resting(plant: FriPlant, arm: str, robot: Robot, console: Console) -> Array:
    """Wait until Enter is pressed while ``arm`` is at rest. Return the mean measured posture of all arms (nv,) [rad].

    If ``arm`` moves, the operator has to press Enter again.
    """
    while True:
        if not sys.stdin.readline():
            raise ConfigError("no more input; allowed: Enter for each point")
        seen = postures_over(plant, _LISTENS)
        moved = np.ptp(seen, axis=0)[robot.arms[arm].joints].max()
        if moved <= _STILL:
            return np.asarray(np.mean(seen, axis=0))
        say(f"the {arm} arm moved by {moved:.4f} rad in {_LISTENS:g} s: hold it still, and press Enter again", console)


def postures_over(plant: FriPlant, duration: float) -> Array:
    """Return the postures (n, nv) [rad] that are measured during ``duration`` [s].

    Raises :class:`PlantError` if a cabinet is silent.
    """
    seen, end = [], time.monotonic() + duration
    while time.monotonic() < end:
        plant.due(time.monotonic())
        seen.append(plant.state().q)
        time.sleep(0.01)
    heard = min(state.arrival for state in plant.states().values())
    if time.monotonic() - heard > _LISTENS:
        fault = plant.fault()
        raise PlantError("a cabinet is silent" if fault is None else sentence(fault))
    return np.array(seen)
