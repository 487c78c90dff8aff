"""Resolve joints with a ``<mimic>``: each becomes a linear function of the joint that finally drives it."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

from q2r2_control.errors import RobotError
from q2r2_control.robot.urdf_parts import CONTINUOUS_RANGE, mimic_of


@dataclass(frozen=True, slots=True)
class Follower:
    """A joint that is at ``multiplier * q + offset`` when its driver is at ``q`` [rad or m]."""

    driver: str  # A joint without a <mimic>.
    multiplier: float
    offset: float

    def at(self, position: float) -> float:
        """Return the position of the follower if its driver is at ``position``."""
        return self.multiplier * position + self.offset


def followers_of(joints: Iterable[ET.Element], driven: Collection[str] = (), where: str = "") -> dict[str, Follower]:
    """Return all joints that follow another joint, by name.

    If a joint follows a follower, its driver is the driver of that follower.

    Args:
        joints: All joints of the model.
        driven: Joints with a motor. They follow no joint, even with a <mimic>. The same holds for fixed joints.
        where: The text with which an error begins.

    Raises:
        RobotError: If a joint follows a joint that is not in ``joints``, or itself through other joints.
    """
    named = {joint.get("name", ""): joint for joint in joints}
    leads = {
        name: mimic
        for name, joint in named.items()
        if joint.get("type") != "fixed" and name not in driven and (mimic := mimic_of(joint)) is not None
    }
    found = {}
    for name in leads:
        way, multiplier, offset = [name], 1.0, 0.0
        while way[-1] in leads:
            leader, by, beside = leads[way[-1]]
            if leader not in named:
                raise RobotError(f"{where}joint {way[-1]} mimics {leader!r:.60}; allowed: a joint of the model")
            if leader in way:
                circle = " mimics ".join([*way[way.index(leader) :], leader])
                raise RobotError(f"{where}joint {circle}; allowed: mimics that end at a joint without one")
            multiplier, offset = multiplier * by, offset + multiplier * beside
            way.append(leader)
        found[name] = Follower(way[-1], multiplier, offset)
    return found


def with_followers(positions: Mapping[str, float], followers: Mapping[str, Follower]) -> dict[str, float]:
    """Return ``positions`` by joint [rad or m], with the positions of all followers of these joints added."""
    followed = {name: one.at(positions[one.driver]) for name, one in followers.items() if one.driver in positions}
    return followed | dict(positions)


def narrow_limits(joints: Collection[ET.Element], where: str = "") -> None:
    """Narrow the limits of drivers in place, so that all followers stay within their own limits.

    A follower has no effect if it has no limits, if it is continuous, or if it does not move. In models of mirrored
    fingers, the limits of a follower may have the wrong sign. They are then replaced by the range in which it follows
    its driver.

    Raises:
        RobotError: In the cases in which :func:`followers_of` raises it, or if a follower leaves its driver no range.
            The text begins with ``where``.
    """
    limits = {joint.get("name", ""): joint.find("limit") for joint in joints}
    for name, follower in followers_of(joints, where=where).items():
        own, driver = limits[name], limits[follower.driver]
        if own is None or driver is None or follower.multiplier == 0.0:
            continue
        lower, upper = (float(own.get(end, "0")) for end in ("lower", "upper"))
        least, most = (float(driver.get(end, "0")) for end in ("lower", "upper"))
        if not (lower < upper and least < most) or (lower <= -CONTINUOUS_RANGE and upper >= CONTINUOUS_RANGE):
            continue
        first, last = sorted((end - follower.offset) / follower.multiplier for end in (lower, upper))
        low, high = max(least, first), min(most, last)
        mirrored = not low < high  # If no position is left, the follower's limits may have the wrong sign.
        if mirrored:
            first, last = sorted((-end - follower.offset) / follower.multiplier for end in (lower, upper))
            low, high = max(least, first), min(most, last)
        if not low < high:
            follows = f"joint {name}, at {lower:g} .. {upper:g}, follows {follower.driver}, at {least:g} .. {most:g}"
            by = f"by {follower.multiplier:g} times it and {follower.offset:g}"
            raise RobotError(f"{where}{follows}, {by}, which leaves no way; allowed: limits that meet")
        if mirrored:
            lower, upper = sorted(map(follower.at, (low, high)))
            own.set("lower", repr(lower))
            own.set("upper", repr(upper))
        driver.set("lower", repr(low))
        driver.set("upper", repr(high))
