"""Tables of ``q2r2 check``."""

from __future__ import annotations

from rich.table import Table
from rich.text import Text

from q2r2_control.cli.cell_report import ArmCheck, CellCheck, PairsWritten
from q2r2_control.robot.stop_torque import StopTorque


def arm_table(arm: ArmCheck) -> Table:
    """One arm's joints and limits."""
    position = " ".join(f"{value:.3f}" for value in arm.tool_position)
    flange = "" if arm.flange is None else f", flange {arm.flange}"
    tool = f"tool {arm.tool_model or 'none'}; {arm.tool_frame} at home at {position} m"
    title = f"{arm.name} arm: {arm.model}{flange}, {tool}"
    table = _table_of(title, "joint")
    # Units below, which leaves 26 of 80 columns for names.
    for column in ("min\n[rad]", "home\n[rad]", "max\n[rad]", "speed\n[rad/s]", "torque\n[Nm]"):
        table.add_column(Text(column), justify="right", min_width=7)
    for joint in arm.joints:
        figures = (joint.lower, joint.home, joint.upper, joint.velocity, joint.torque)
        table.add_row(Text(joint.name), *(f"{value:.3f}" for value in figures))
    return table


def stop_table(stop: StopTorque) -> Table:
    """What a full stop of one arm asks of its joints."""
    title = f"{stop.arm} arm: most torque in {stop.postures} random postures, of each joint's limit"
    table = _table_of(title, "joint")
    for column in ("stops at\n[rad/s^2]", "gravity\n[%]", "full stop\n[%]"):
        table.add_column(Text(column), justify="right")
    for joint in stop.joints:
        shares = (f"{100 * share:.0f}" for share in (joint.gravity, joint.stop))
        table.add_row(Text(joint.joint), f"{joint.acceleration:.2f}", *shares)
    return table


def obstacle_table(check: CellCheck) -> Table:
    """What stands in the cell."""
    empty = not check.obstacles and check.floor is None
    table = Table(title="no obstacles, no floor" if empty else "obstacles", title_justify="left")
    table.add_column("name", overflow="fold")
    for column in ("shape", "size [m]", "centre [m]"):
        table.add_column(Text(column))
    for name, obstacle in check.obstacles.items():
        table.add_row(Text(name), obstacle.shape, _numbers(obstacle.size), _numbers(obstacle.position))
    if check.floor is not None:
        table.add_row("floor", "plane", "", f"0 0 {check.floor:g}")
    return table


def pair_table(check: CellCheck) -> Table:
    """The nearest pairs at home."""
    title = f"nearest of {check.monitored_pairs} monitored pairs at home, min_distance {1e3 * check.min_distance:g} mm"
    table = _table_of(title, "pair")
    table.add_column(Text("distance\n[mm]"), justify="right", min_width=8)
    table.add_column(Text("kept\n[mm]"), justify="right", min_width=4)
    for pair in check.nearest:
        table.add_row(Text(f"{pair.name_a} | {pair.name_b}"), f"{1e3 * pair.distance:.1f}", f"{1e3 * pair.kept:g}")
    return table


def control_table(check: CellCheck) -> Table:
    """What the controls of each hand do."""
    table = _table_of("controls of each hand", "control")
    table.add_column("does")
    for control, meaning in check.controls.items():
        table.add_row(control, meaning)
    return table


def pair_reach_table(pairs: PairsWritten) -> Table:
    """Which pairs of links cannot meet."""
    title = (
        f"{pairs.file}: {len(pairs.never)} of {len(pairs.never) + len(pairs.watched)} pairs of links stay more than "
        f"{1e3 * pairs.clearance:g} mm apart"
    )
    table = _table_of(title, "pair")
    table.add_column(Text("nearest found [mm]"), justify="right", min_width=8)
    for pair in pairs.never:
        table.add_row(Text(f"{pair.link_a} | {pair.link_b}"), f"{1e3 * pair.nearest:.0f}")
    return table


def model_pairs_table(files: dict[str, bool]) -> Table:
    """Which files there are for the models of a cell."""
    table = Table(title="pairs of the models' links that need no watching", title_justify="left")
    table.add_column("file", overflow="fold")
    table.add_column("is")
    for file, new in files.items():
        table.add_row(Text(file), "new" if new else "as it was")
    return table


def _table_of(title: str, names: str) -> Table:
    """A table whose first column holds ``names``, which are never cut: too long ones go on in the next line."""
    table = Table(title=Text(title), title_justify="left", min_width=len(title))
    table.add_column(names, overflow="fold")
    return table


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:g}" for value in values)
