"""Tables of what a command found out."""

from __future__ import annotations

from rich.table import Table
from rich.text import Text

from q2r2_control.cli.cell_report import ArmCheck, CellCheck, PairsWritten
from q2r2_control.inputs.headset_check import HeadsetCheck
from q2r2_control.runtime.run_summary import Percentiles, RunSummary
from q2r2_control.runtime.torque_summary import TorqueSummary
from q2r2_control.viewer.topic_table import topic_table


def summary_table(summary: RunSummary) -> Table:
    """What a run amounted to."""
    table = Table(title="summary", title_justify="left", show_header=False)
    table.add_row("duration", f"{summary.duration_s:.2f} s, {summary.ticks} ticks, {summary.loop_rate_hz:.0f} Hz")
    table.add_row("tick", _percentiles(summary.tick_us, "us", 0))
    table.add_row("input to command", _percentiles(summary.input_to_command_ms, "ms", 2))
    for name, arm in summary.arms.items():
        figures = f"engaged {arm.engaged_s:.2f} s"
        if arm.position_error_mm_rms is not None and arm.rotation_error_deg_rms is not None:
            figures += f", error {arm.position_error_mm_rms:.2f} mm, {arm.rotation_error_deg_rms:.2f} deg RMS"
        if arm.slip_mm_max > 0.0 or arm.slip_deg_max > 0.0:
            figures += f", target slipped {arm.slip_mm_max:.0f} mm, {arm.slip_deg_max:.0f} deg"
        if arm.yielded_mm_max > 0.0 or arm.yielded_deg_max > 0.0:
            figures += f", yielded {arm.yielded_mm_max:.0f} mm, {arm.yielded_deg_max:.0f} deg"
        table.add_row(f"{name} arm", f"{figures}, gripper changes {arm.gripper_changes}")
    if summary.min_distance_mm is not None and summary.closest_pair is not None:
        table.add_row("nearest pair", f"{summary.min_distance_mm:.1f} mm, {' | '.join(summary.closest_pair)}")
    table.add_row(
        "velocity, acceleration",
        f"{_share(summary.max_velocity_ratio)} of the limits at most, {_share(summary.max_acceleration_ratio)}",
    )
    table.add_row("room to position limits", f"{summary.min_position_margin_rad:.3f} rad at least")
    table.add_row("certified stops executed", f"{summary.fallback_ticks} ticks, {summary.uncertified_ticks} without")
    table.add_row("targets rejected", str(summary.rejected_targets))
    if summary.torque is not None:
        _add_torque(table, summary.torque)
    table.add_row("arms at the end", "at rest" if summary.at_rest else "[red]moving[/]")
    return table


def _add_torque(table: Table, torque: TorqueSummary) -> None:
    if torque.min_measured_distance_mm is not None and torque.measured_closest_pair is not None:
        pair = " | ".join(torque.measured_closest_pair)
        table.add_row("nearest measured pair", f"{torque.min_measured_distance_mm:.1f} mm, {pair}")
    pressed = ", ".join(" | ".join(pair) for pair in torque.pressed_pairs)
    force = f": {torque.max_wall_force_n:.0f} N at most" if pressed else ""
    table.add_row("wall pressed by", f"{pressed or 'no pair'}{force}")
    limits = f"{torque.saturated_ticks} ticks at a limit, {torque.rate_limited_ticks} at the rate limit"
    table.add_row("torque", f"{limits}, {torque.held_ticks} held without a measurement")
    for arm, time in torque.off_reference_s.items():
        if time > 0.0:
            table.add_row(f"{arm} arm off its reference", f"[red]{time:.2f} s[/] beyond the impedance's error clip")


def arm_table(arm: ArmCheck) -> Table:
    """One arm's joints and limits."""
    position = " ".join(f"{value:.3f}" for value in arm.tool_position)
    title = f"{arm.name} arm: {arm.model}, tool {arm.tool_model or 'none'}; {arm.tool_frame} at home at {position} m"
    table = _table_of(title, "joint")
    # Units below, which leaves 26 of 80 columns for names.
    for column in ("min\n[rad]", "home\n[rad]", "max\n[rad]", "speed\n[rad/s]", "torque\n[Nm]"):
        table.add_column(Text(column), justify="right", min_width=7)
    for joint in arm.joints:
        figures = (joint.lower, joint.home, joint.upper, joint.velocity, joint.torque)
        table.add_row(Text(joint.name), *(f"{value:.3f}" for value in figures))
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
    table.add_column(Text("distance [mm]"), justify="right", min_width=8)
    for pair in check.nearest:
        table.add_row(Text(f"{pair.name_a} | {pair.name_b}"), f"{1e3 * pair.distance:.1f}")
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


def headset_table(check: HeadsetCheck) -> Table:
    """Connection, topics, and where the hands move."""
    statistics = check.statistics
    state = f"{statistics.peer} connected" if statistics.peer else "nobody is connected"
    dialect = f", dialect {statistics.dialect}" if statistics.dialect else ""
    address = "{}:{}".format(*statistics.address)
    table = topic_table(f"headset on {address}: {state}{dialect}", dict(sorted(statistics.topics.items())))
    for name, count in statistics.unknown_topics.items():
        table.add_row(Text(name), str(count), "", "", "not read")
    table.add_section()
    for hand, direction in check.directions.items():
        position = check.positions[hand]
        where = "" if position is None else "at " + " ".join(f"{value:.2f}" for value in position)
        table.add_row(f"{hand} hand moves", "", "", "", f"{direction}  {where}")
    # Text, since a reason may quote what the other side sent, and markup would be obeyed.
    table.caption = Text("\n".join(check.advice)) if check.advice else None
    table.caption_justify = "left"
    return table


def _table_of(title: str, names: str) -> Table:
    """A table whose first column holds ``names``, which are never cut: too long ones go on in the next line."""
    table = Table(title=Text(title), title_justify="left", min_width=len(title))
    table.add_column(names, overflow="fold")
    return table


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:g}" for value in values)


def _percentiles(values: Percentiles, unit: str, digits: int) -> str:
    if values.p50 is None or values.p99 is None or values.max is None:
        return "-"
    return f"median {values.p50:.{digits}f} {unit}, p99 {values.p99:.{digits}f}, max {values.max:.{digits}f}"


def _share(ratio: float) -> str:
    return f"{100.0 * ratio:.0f} %"
