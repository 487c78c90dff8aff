"""The distance that each monitored pair keeps: ``min_distance``, ``distances``, ``pairs`` and ``contact_allowed``."""

from __future__ import annotations

from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np

from q2r2_control.config.control import ControllerSettings
from q2r2_control.errors import ConfigError
from q2r2_control.robot.command_average import average_allowance
from q2r2_control.robot.near_pairs import NearPair, remedy
from q2r2_control.robot.obstacle_bodies import roles_with_obstacles, with_obstacle_bodies
from q2r2_control.robot.pairs import LinkClass, Role, link_of, pair_names
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

_OUTERMOST_FIRST = list(LinkClass)


@dataclass(frozen=True, slots=True)
class KeptDistances:
    """The distances that pairs have to keep. The monitored pairs of a robot are in the order of ``Robot.distances``."""

    values: Array  # Kept distances (p,) [m]. For a pair that may touch: minus the depth that the reference permits.
    keys: tuple[str, ...]  # Keys in the block ``control``, such as min_distance, distances.arm_arm or pairs[0].
    # Greatest closing speeds near contact of pairs that may touch (p,) [m/s]; infinite for others.
    contact_speed: Array


def kept_distances(robot: Robot, settings: ControllerSettings) -> KeptDistances:
    """Return the distance that every monitored pair of ``robot`` has to keep.

    With a limit of jerk, these distances are larger by :func:`average_allowance`, because the commands are not exactly
    on the reference's path.

    Raises:
        ConfigError: If an entry of ``settings.pairs`` or ``settings.contact_allowed`` matches no monitored pair, or if
            ``settings.jerk_limit`` does not fit the robot.
    """
    return _of_all_pairs(robot, settings)[0]


def kept_by_objects(robot: Robot, settings: ControllerSettings) -> KeptDistances:
    """Return the distances that the pairs of ``robot.objects`` keep; raises as :func:`kept_distances` does."""
    return _of_all_pairs(robot, settings)[1]


def kept_by_obstacles(robot: Robot, settings: ControllerSettings) -> KeptDistances:
    """Return the distances that the pairs of moving obstacles keep; raises as :func:`kept_distances` does."""
    return _of_all_pairs(robot, settings)[2]


def near_at_home(robot: Robot, kept: KeptDistances) -> list[NearPair]:
    """Return the pairs that are closer at home than the distance that they have to keep, the closest first."""
    pairs = zip(robot.distances(robot.home), kept.values.tolist(), kept.keys, strict=True)
    found = [NearPair((pair.name_a, pair.name_b), pair.distance, least, key) for pair, least, key in pairs]
    return sorted((pair for pair in found if pair.distance < pair.kept), key=lambda pair: pair.distance)


def too_close_at_home(robot: Robot, kept: KeptDistances, *, remedies: bool = False) -> list[str]:
    """Return a line for each pair of :func:`near_at_home`.

    With ``remedies`` the line also says what to write into the cell's YAML. To find this, postures are sampled.
    """
    lines = []
    for pair in near_at_home(robot, kept):
        apart = f"{' and '.join(pair.names)} are {1e3 * pair.distance:.1f} mm apart"
        hint = f"; {remedy(robot, pair)}" if remedies else ""
        lines.append(f"home: {apart}; allowed: at least {pair.key}, {1e3 * pair.kept:.1f} mm{hint}")
    return lines


def _of_all_pairs(robot: Robot, settings: ControllerSettings) -> tuple[KeptDistances, KeptDistances, KeptDistances]:
    """Return the distances of three groups of pairs: of the robot, of held objects, and of moving obstacles."""
    geometry = with_obstacle_bodies(robot, settings.moving_obstacles)
    names = pair_names(geometry)
    roles = roles_with_obstacles(robot, settings.moving_obstacles)
    keys = ["min_distance"] * len(names)
    values = np.full(len(names), settings.min_distance)
    for p, (a, b) in enumerate(names):
        name = pair_class(roles[link_of(a)], roles[link_of(b)])
        value = getattr(settings.distances, name)
        if value is not None:
            values[p], keys[p] = value, f"distances.{name}"
    for i, named in enumerate(settings.pairs):
        for p in _found(f"pairs[{i}]", named.pair, names):
            values[p], keys[p] = named.distance, f"pairs[{i}]"
    speed = np.full(len(names), np.inf)
    count = len(robot.collision_model.collisionPairs)
    last = count + len(robot.objects.holders)
    # Pairs of held objects need no contact_allowed, because a cell can set negative distances for them.
    for i, contact in enumerate(settings.contact_allowed):
        for p in _found(f"contact_allowed[{i}]", contact.pair, names[:count]):
            values[p], keys[p], speed[p] = -contact.depth, f"contact_allowed[{i}]", contact.speed
    values += average_allowance(robot, settings, geometry)
    parts = slice(0, count), slice(count, last), slice(last, None)
    one, two, three = (KeptDistances(values[part], tuple(keys[part]), speed[part]) for part in parts)
    return one, two, three


def pair_class(first: Role, second: Role) -> str:
    """Return the key of ``control.distances`` for two links."""
    parts = sorted((first.part, second.part), key=_OUTERMOST_FIRST.index)
    same_robot = first.arms & second.arms or not (first.arms and second.arms)
    if LinkClass.OBSTACLE not in parts and same_robot:
        return "arm_self"
    return f"{parts[0]}_{parts[1]}"


def _found(key: str, patterns: tuple[str, str], names: tuple[tuple[str, str], ...]) -> list[int]:
    """Return the indices of the pairs that match ``patterns``."""
    one, two = patterns
    found = [p for p, (a, b) in enumerate(names) if (_is(one, a) and _is(two, b)) or (_is(one, b) and _is(two, a))]
    if not found:
        raise ConfigError(f"control.{key}.pair = {list(patterns)!s:.120}: {_why_none(patterns, names)}")
    return found


def _is(pattern: str, geometry: str) -> bool:
    """Return whether ``pattern`` matches the link of the body ``geometry``, or the body's name in reports."""
    return fnmatchcase(link_of(geometry), pattern) or fnmatchcase(geometry, pattern)


def _why_none(patterns: tuple[str, str], names: tuple[tuple[str, str], ...]) -> str:
    bodies = {name for pair in names for name in pair}
    for pattern in patterns:
        if not any(_is(pattern, name) for name in bodies):
            links = ", ".join(sorted({link_of(name) for name in bodies}))
            return f"no monitored body is called {pattern!r:.60}; allowed: names of links, * and ?: {links}"
    return "these are no monitored pair: neighbours, what an SRDF leaves out, or both fixed; allowed: monitored pairs"
