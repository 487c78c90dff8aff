"""Pairs that are too near at home: whether they ever part, and what a user can change about them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from q2r2_control.config.control import ControllerSettings
from q2r2_control.robot.floor import FLOOR
from q2r2_control.robot.pairs import link_of
from q2r2_control.types import Interval

if TYPE_CHECKING:
    from q2r2_control.robot.robot import Robot

_POSTURES = 50  # that are looked at besides home
_NAMED = 4  # pairs in one warning

Pair = tuple[str, str]  # names of bodies, or of links


def spreads_of(robot: Robot, pairs: Sequence[Pair]) -> dict[Pair, Interval]:
    """Least and greatest distance [m] of ``pairs`` of bodies, watched or not, at home and in the same random postures.

    Pairs of links: bodies of the same two links count together.
    """
    geometry = robot.collision_model.copy()
    geometry.removeAllCollisionPairs()
    for pair in pairs:
        geometry.addCollisionPair(pin.CollisionPair(*map(geometry.getGeometryId, pair)))
    data, geometry_data = robot.model.createData(), geometry.createData()
    random = np.random.default_rng(0).uniform(robot.position_lower, robot.position_upper, (_POSTURES, robot.model.nv))
    spreads: dict[Pair, Interval] = {}
    for q in (robot.home, *random):
        pin.computeDistances(robot.model, data, geometry, geometry_data, q)
        now: dict[Pair, float] = {}
        for (a, b), found in zip(pairs, geometry_data.distanceResults, strict=True):
            links = link_of(a), link_of(b)
            now[links] = min(float(found.min_distance), now.get(links, math.inf))
        for links, distance in now.items():
            least, greatest = spreads.get(links, (math.inf, -math.inf))
            spreads[links] = min(least, distance), max(greatest, distance)
    return spreads


def remedy(robot: Robot, pair: Pair, distance: float, kept: float) -> str:
    """Lines for the YAML of a cell in which a ``pair`` is ``distance`` apart at home and has to keep ``kept`` [m]."""
    links = link_of(pair[0]), link_of(pair[1])
    if FLOOR in links:
        return "the key floor takes another height, or null for no floor"
    if not robot.roles[links[0]].arms & robot.roles[links[1]].arms:
        return "to change: another home"
    least, greatest = spreads_of(robot, [pair])[links]
    nearer = _whole_millimetres(distance if greatest >= kept else least)
    by_name = f"control.pairs: [{{pair: [{', '.join(links)}], distance: {nearer:g}}}]" if nearer >= 0.0 else ""
    if greatest >= kept:
        return f"to change: {', or '.join(filter(None, ('another home', by_name)))}"
    in_file = f"a file for srdf, such as q2r2 check --pairs writes, with the line {_srdf_line(links)}"
    return f"they hardly part anywhere; to change: {', or '.join(filter(None, (by_name, in_file)))}"


def warning_at_home(robot: Robot) -> str | None:
    """One line about pairs that are nearer at home than usual settings allow, and about overlapping ones that part."""
    kept = ControllerSettings().min_distance
    near = {(pair.name_a, pair.name_b): pair for pair in robot.distances(robot.home) if pair.distance < kept}
    if not near and not robot.ignored_pairs:
        return None
    spreads = spreads_of(robot, [*near, *robot.ignored_pairs])
    lines: dict[Pair, str] = {}
    never: list[Pair] = []
    for pair in sorted(near.values(), key=lambda found: found.distance):
        links = link_of(pair.name_a), link_of(pair.name_b)
        greatest = spreads[links][1]
        if links not in lines and greatest < kept:
            never.append(links)
        apart = f"{' and '.join(links)} are {1e3 * pair.distance:.1f} mm apart"
        nowhere = f" and {1e3 * greatest:.1f} mm at most in {_POSTURES} other postures" if greatest < kept else ""
        lines.setdefault(links, apart + nowhere)
    for a, b in robot.ignored_pairs:
        links = link_of(a), link_of(b)
        if spreads[links][1] >= kept:
            lines.setdefault(links, f"{' and '.join(links)} overlap, and are not watched, though they can part")
    if not lines:
        return None
    more = f"; and {len(lines) - _NAMED} more" if len(lines) > _NAMED else ""
    text = f"{robot.name}: at home, with min_distance {1e3 * kept:g} mm: {'; '.join([*lines.values()][:_NAMED])}{more}"
    remedies = [] if len(never) == len(lines) else ["home={joint: position, ...} where pairs are apart"]
    if never:
        disabled = "".join(map(_srdf_line, never[:_NAMED]))
        pairs = [{"pair": links, "distance": _whole_millimetres(spreads[links][0])} for links in never[:_NAMED]]
        remedies.append(f"srdf='<robot name=\"{robot.name}\">{disabled}</robot>'")
        if all(spreads[links][0] >= 0.0 for links in never):
            remedies.append(f"ControllerSettings(pairs={pairs})")
    return f"{text}; the arm may not move freely from there; to change: {', or '.join(remedies)}"


def _whole_millimetres(distance: float) -> float:
    return math.floor(1e3 * distance) / 1e3


def _srdf_line(links: Pair) -> str:
    return f'<disable_collisions link1="{links[0]}" link2="{links[1]}" reason="Never"/>'
