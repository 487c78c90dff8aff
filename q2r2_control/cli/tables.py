"""Tables of ``q2r2 check``."""

from __future__ import annotations

from rich.table import Table
from rich.text import Text

from q2r2_control.cli.cell_report import ArmCheck, CellCheck, PairsWritten


def arm_table(arm: ArmCheck) -> Table:
    """One arm's joints and limits."""
    position = " ".join(f"{value:.3f}" for value in arm.tool_position)
    title = f"{arm.name} arm: {arm.model}, tool {arm.tool_model or 'none'}; {arm.tool_frame} at home at {position} m"
    table = Table(title=Text(title), title_justify="left", min_width=len(title))
    table.add_column("joint")
    for column in ("min [rad]", "home [rad]", "max [rad]", "speed [rad/s]", "torque [Nm]"):
        table.add_column(Text(column), justify="right")
    for joint in arm.joints:
        figures = (joint.lower, joint.home, joint.upper, joint.velocity, joint.torque)
        table.add_row(joint.name, *(f"{value:.3f}" for value in figures))
    return table


def obstacle_table(check: CellCheck) -> Table:
    """What stands in the cell."""
    table = Table(title="obstacles" if check.obstacles else "no obstacles", title_justify="left")
    for column in ("name", "shape", "size [m]", "centre [m]"):
        table.add_column(Text(column))
    for name, obstacle in check.obstacles.items():
        table.add_row(Text(name), obstacle.shape, _numbers(obstacle.size), _numbers(obstacle.position))
    return table


def pair_table(check: CellCheck) -> Table:
    """The nearest pairs at home."""
    title = f"nearest of {check.monitored_pairs} monitored pairs at home, min_distance {1e3 * check.min_distance:g} mm"
    table = Table(title=Text(title), title_justify="left", min_width=len(title))
    table.add_column("pair")
    table.add_column(Text("distance [mm]"), justify="right")
    for pair in check.nearest:
        table.add_row(f"{pair.name_a} | {pair.name_b}", f"{1e3 * pair.distance:.1f}")
    return table


def pair_reach_table(pairs: PairsWritten) -> Table:
    """Which pairs of links cannot meet."""
    title = (
        f"{pairs.file}: {len(pairs.never)} of {len(pairs.never) + len(pairs.watched)} pairs of links stay more than "
        f"{1e3 * pairs.clearance:g} mm apart"
    )
    table = Table(title=Text(title), title_justify="left", min_width=len(title))
    table.add_column("pair")
    table.add_column(Text("nearest found [mm]"), justify="right")
    for pair in pairs.never:
        table.add_row(f"{pair.link_a} | {pair.link_b}", f"{1e3 * pair.nearest:.0f}")
    return table


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:g}" for value in values)
