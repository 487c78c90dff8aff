"""The interface of a controller in the bench, and the settings that all peers get."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import pinocchio as pin

from q2r2_control.config.cell import Config
from q2r2_control.robot.compose import compose
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

# Peer -> the package that it needs, which is the name of its module here too.
PEERS = {
    "roboplan": "roboplan",
    "roboplan, 10 nearest": "roboplan",
    "mink": "mink",
    "pink, 10 nearest": "pink",
}
WITHOUT_ACCELERATION_LIMIT = ("mink",)
INSTALL = "pip install 'q2r2_control[bench]'"
NEAREST_ROWS = 10  # separation rows of a peer that is given the nearest pairs only
DETECTION_DISTANCE = 0.25  # pairs farther apart than this need no exact distance [m]


class BenchController(Protocol):
    """A controller that runs open loop: it integrates its own configuration."""

    name: str
    limitations: str  # which parts of our contract it cannot keep, in a few words

    def reset(self, q: Array) -> None:
        """Start at rest at ``q`` (nv,) [rad], in the order of ``Robot.joint_names``."""

    def step(self, targets: Mapping[str, pin.SE3], dt: float) -> tuple[Array, Array]:
        """One tick: positions [rad] and velocities [rad/s] after it, (nv,) each. Raises where it has no solution."""

    def hold(self) -> tuple[Array, Array]:
        """The tick after a failure: the same positions, at rest."""


@dataclass(frozen=True, slots=True)
class PeerSettings:
    """Our settings in the units of the peers: gains per tick, limits with our margins."""

    robot: Robot
    config: Config
    dt: float  # [s]

    @property
    def position_gain(self) -> float:
        """Part of the tool's position error that a tick removes."""
        return self.config.control.position_gain * self.dt

    @property
    def posture_gain(self) -> float:
        """Part of the posture error that a tick removes."""
        return self.config.control.posture_gain * self.dt

    @property
    def posture_cost(self) -> float:
        """Square root of the posture's weight against the tool's 1."""
        return float(self.config.control.posture_weight**0.5)

    @property
    def velocity(self) -> Array:
        """(nv,) [rad/s]"""
        return self.robot.velocity_limit * self.config.control.velocity_scale

    @property
    def acceleration(self) -> Array:
        """(nv,) [rad/s^2]"""
        return self.robot.capped_acceleration(self.config.control.acceleration_limit)

    @property
    def lower(self) -> Array:
        """(nv,) [rad]"""
        return self.robot.position_lower + self.config.control.position_margin

    @property
    def upper(self) -> Array:
        """(nv,) [rad]"""
        return self.robot.position_upper - self.config.control.position_margin

    @property
    def min_distance(self) -> float:
        """The smallest distance that we keep of any pair [m]: peers know one for all, and none is refused our work."""
        return float(
            kept_distances(self.robot, self.config.control).values.min(initial=self.config.control.min_distance)
        )

    def home_of_others(self) -> dict[str, float]:
        """Home positions of joints that move no tool, such as fingers."""
        home = compose(self.config).home
        return {name: value for name, value in home.items() if name not in self.robot.joint_names}


def make_peer(name: str, setup: PeerSettings) -> BenchController:
    """Build a peer of ``PEERS``. Raises what its package raises."""
    module = importlib.import_module(f"q2r2_control.benchmark.peers.{PEERS[name]}")
    peer: BenchController = module.make(setup, name)
    return peer


def is_installed(name: str) -> bool:
    """Whether a peer's package can be found."""
    return importlib.util.find_spec(PEERS[name]) is not None


def build_peers(names: Sequence[str], setup: PeerSettings) -> tuple[list[BenchController], list[str]]:
    """The peers that can be built, and a line on each of ``names``: its limitations, or why there is none."""
    peers: list[BenchController] = []
    notes = []
    for name in names:
        if not is_installed(name):
            notes.append(f"{name}: not installed; {INSTALL}")
            continue
        try:
            peer = make_peer(name, setup)
        except Exception as error:  # a package of another version may raise anything
            notes.append(f"{name}: cannot be built for this cell: {type(error).__name__}: {error}")
            continue
        peers.append(peer)
        notes.append(f"{name}: {peer.limitations}")
    return peers, notes


class Leading:
    """A peer that is given its targets ahead along their way."""

    def __init__(self, peer: BenchController, gain: float) -> None:
        """``gain`` of the peer's tools [1/s]."""
        self.name, self.limitations = peer.name, peer.limitations
        self._peer, self._gain = peer, gain
        self._last: Mapping[str, pin.SE3] = {}

    def reset(self, q: Array) -> None:
        """See :class:`BenchController`."""
        self._last = {}
        self._peer.reset(q)

    def step(self, targets: Mapping[str, pin.SE3], dt: float) -> tuple[Array, Array]:
        """See :class:`BenchController`."""
        last, self._last = self._last or targets, targets
        return self._peer.step({arm: self._ahead(last[arm], pose, dt) for arm, pose in targets.items()}, dt)

    def hold(self) -> tuple[Array, Array]:
        """See :class:`BenchController`."""
        return self._peer.hold()

    def _ahead(self, last: pin.SE3, pose: pin.SE3, dt: float) -> pin.SE3:
        """Where ``pose`` would be after 1 / gain, going on as since the ``last`` tick, in a straight line."""
        share = 1.0 / (self._gain * dt)
        turn = pin.exp3(share * pin.log3(pose.rotation @ last.rotation.T))
        return pin.SE3(turn @ pose.rotation, pose.translation + share * (pose.translation - last.translation))
