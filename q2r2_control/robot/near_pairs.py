"""Examine pairs that are too near at home: whether other postures bring them apart, and what a user can change."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pinocchio as pin

from q2r2_control.config.cell import Config
from q2r2_control.config.control import ControllerSettings
from q2r2_control.robot.coal_distances import CoalDistances
from q2r2_control.robot.floor import FLOOR
from q2r2_control.robot.home_search import find_home, mirrored_home
from q2r2_control.robot.pairs import link_of
from q2r2_control.types import Interval

if TYPE_CHECKING:
    from q2r2_control.robot.robot import Robot

_POSTURES = 50  # Number of random postures that are examined besides home.
_NAMED = 4  # Greatest number of pairs in one warning.

Pair = tuple[str, str]  # The names of two bodies or of two links.


def spreads_of(robot: Robot, pairs: Sequence[Pair]) -> dict[Pair, Interval]:
    """Return the least and the greatest distance of pairs of links [m], at home and in random postures.

    The postures are always the same. ``pairs`` are the names of bodies, whose pairs need not be monitored. Bodies of
    the same two links count together, and so the keys are pairs of links.
    """
    geometry = robot.collision_model.copy()
    geometry.removeAllCollisionPairs()
    for pair in pairs:
        geometry.addCollisionPair(pin.CollisionPair(*map(geometry.getGeometryId, pair)))
    distances = CoalDistances(robot.model, geometry)
    random = np.random.default_rng(0).uniform(robot.position_lower, robot.position_upper, (_POSTURES, robot.model.nv))
    spreads: dict[Pair, Interval] = {}
    for q in (robot.home, *random):
        now: dict[Pair, float] = {}
        for (a, b), distance in zip(pairs, distances.at(q).tolist(), strict=True):
            links = link_of(a), link_of(b)
            now[links] = min(distance, now.get(links, math.inf))
        for links, distance in now.items():
            least, greatest = spreads.get(links, (math.inf, -math.inf))
            spreads[links] = min(least, distance), max(greatest, distance)
    return spreads


class NearPair(NamedTuple):
    """A pair of bodies that is nearer at home than the distance that it has to keep."""

    names: Pair
    distance: float  # [m]
    kept: float  # The distance that it has to keep [m].
    key: str  # The key in the block ``control`` that names this distance.


class _Remedies(NamedTuple):
    """Possible remedies for a pair that belongs to one robot."""

    links: Pair
    can_be_apart: bool  # True if the pair has its required distance in at least one of the examined postures.
    nearer: float | None  # A smaller distance that control.pairs could name instead [m]; None if there is none.


def _remedies_of(robot: Robot, pair: NearPair) -> _Remedies | None:
    """Return the remedies for a pair.

    Returns None for bodies of two arms, for obstacles and for the floor, because these have to keep their distance.
    """
    links = link_of(pair.names[0]), link_of(pair.names[1])
    if FLOOR in links or not robot.roles[links[0]].arms & robot.roles[links[1]].arms:
        return None
    least, greatest = spreads_of(robot, [pair.names])[links]
    nearer = _whole_millimetres(pair.distance if greatest >= pair.kept else least)
    return _Remedies(links, greatest >= pair.kept, nearer if nearer >= 0.0 else None)


def remedy(robot: Robot, pair: NearPair) -> str:
    """Return a text with the changes that make a near ``pair`` allowed, such as another home."""
    if FLOOR in map(link_of, pair.names):
        return "the key floor takes another height, or null for no floor"
    remedies = _remedies_of(robot, pair)
    if remedies is None:
        return "to change: another home"
    by_name = "" if remedies.nearer is None else f"control: {{pairs: [{_pair_entry(remedies.links, remedies.nearer)}]}}"
    if remedies.can_be_apart:
        return f"to change: {', or '.join(filter(None, ('another home', by_name)))}"
    in_file = f"a file for srdf, such as q2r2 check --pairs writes, with the line {_srdf_line(remedies.links)}"
    return f"they hardly part anywhere; to change: {', or '.join(filter(None, (by_name, in_file)))}"


def lines_to_paste(robot: Robot, config: Config, near: Iterable[NearPair]) -> list[str]:
    """Return lines for the cell's YAML that allow ``near`` pairs of a robot's own links to be as near as they are.

    Other lines say where these lines belong.
    """
    nearer: dict[Pair, float] = {}
    disabled: dict[Pair, str] = {}
    for remedies in (_remedies_of(robot, pair) for pair in near):
        if remedies is not None and remedies.nearer is not None:
            nearer[remedies.links] = min(remedies.nearer, nearer.get(remedies.links, math.inf))
        elif remedies is not None and not remedies.can_be_apart:
            disabled[remedies.links] = f"  {_srdf_line(remedies.links)}"
    entries = [f"    - {_pair_entry(links, least)}" for links, least in nearer.items() if links not in disabled]
    lines = []
    if entries:
        # If the file already has one of these blocks, the user must add lines to it, because a block cannot occur
        # twice.
        above = [
            key for key in ("control", "pairs") if key in config.model_fields_set | config.control.model_fields_set
        ]
        where = f"below {'.'.join(above)} in" if above else "at the end of"
        lines += [f"Links of one robot that may be as near as they are, {where} the cell's YAML:"]
        lines += ["control:", "  pairs:"][len(above) :] + entries
    if disabled and config.srdf is not None:
        lines += [f"Links that hardly part, before </robot> in {config.srdf}:", *disabled.values()]
    elif disabled:
        file = f"{re.sub(r'[^A-Za-z0-9_-]', '_', config.name)}.srdf"
        lines += ["Links that hardly part, at the end of the cell's YAML:", f"srdf: {file}"]
        lines += [f"and beside it, in a new file {file}:", '<robot name="cell">', *disabled.values(), "</robot>"]
    return lines


def warning_at_home(
    robot: Robot, exclusions: Iterable[ET.Element] | None, positions: Mapping[str, float]
) -> str | None:
    """Return a line about pairs that are nearer at home than usual settings allow; None if there are none.

    Pairs that overlap at home, but not at every posture, are named as well, because they are not watched.

    Args:
        robot: The robot.
        exclusions: The excluded pairs with which the robot was made.
        positions: The positions of all joints with which the robot was made [rad or m].
    """
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
    if elsewhere := len(never) < len(lines):
        # A pair that overlaps at home is not watched. After a change to a home without this overlap, it is watched. If
        # the pair can never keep its distance, the remedies have to include it too.
        hardly = [links for links, (least, greatest) in spreads.items() if least < 0.0 <= greatest < kept]
        never += [links for links in hardly if links not in never]
    # With an SRDF, links that overlap at home are no longer left out automatically. The lines for the SRDF therefore
    # name these links too.
    disabled = [_srdf_line(links) for links, (_, greatest) in spreads.items() if greatest < kept]
    remedies = []
    if never:
        pairs = [{"pair": links, "distance": _whole_millimetres(spreads[links][0])} for links in never]
        file = f"srdf='<robot name=\"{robot.name}\">{''.join(disabled)}</robot>'"
        remedies.append(file if exclusions is None else f"in the SRDF {''.join(disabled)}")
        if all(spreads[links][0] >= 0.0 for links in never):
            remedies.append(f"ControllerSettings(pairs={pairs})")
    change = ", or ".join(remedies)
    if elsewhere:
        watched = [*(exclusions or ()), *map(ET.fromstring, disabled)]
        tools = {name: arm.tool_frame for name, arm in robot.arms.items()}
        home = _home_apart(type(robot)(ET.fromstring(robot.urdf), watched, tools, positions, robot.name), kept)
        also = f", and for links that hardly part {change}" if never else ""
        change = f"home={home or '{joint: position, ...} where pairs are apart'}{also}"
    return f"{text}; the arm may not move freely from there; to change: {change}"


def _home_apart(robot: Robot, kept: float) -> dict[str, float] | None:
    """Return positions by joint at which all pairs are at least ``kept`` [m] apart; None if none are found."""
    q, room, placed = robot.home.copy(), np.full(len(robot.collision_model.collisionPairs), kept), list[str]()
    for name, arm in robot.arms.items():
        like = mirrored_home(robot, name, placed[0], q) if placed else None
        q[arm.joints] = find_home(robot, name, q, room, placed, like)
        placed.append(name)
    q = np.clip(q.round(2), robot.position_lower, robot.position_upper)
    found = bool((robot.distance_values(q) >= room).all())
    return dict(zip(robot.joint_names, q.tolist(), strict=True)) if found else None


def _whole_millimetres(distance: float) -> float:
    return math.floor(1e3 * distance) / 1e3


def _srdf_line(links: Pair) -> str:
    return f'<disable_collisions link1="{links[0]}" link2="{links[1]}" reason="Never"/>'


def _pair_entry(links: Pair, distance: float) -> str:
    return f"{{pair: [{', '.join(links)}], distance: {distance:g}}}"
