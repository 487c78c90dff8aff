"""The interface of a controller in the bench, and the settings for all peers, which are other public controllers."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Mapping, Sequence
from typing import Protocol

import pinocchio as pin

from q2r2_control.config.cell import Config
from q2r2_control.extras import install_line
from q2r2_control.robot.compose import compose
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

# The package that each peer needs. The peer's module and class in this folder have the name of the package.
PEERS = {
    "roboplan": "roboplan",
    "roboplan, 10 nearest": "roboplan",
    "mink": "mink",
    "pink, 10 nearest": "pink",
    "embodik, 10 nearest": "embodik",
}
WITHOUT_ACCELERATION_LIMIT = ("mink",)
INSTALL = install_line("bench")
NEAREST_ROWS = 10  # Number of pairs for which a peer has separation rows, if it considers only the nearest pairs.
DETECTION_DISTANCE = 0.25  # Pairs farther apart than this need no exact distance [m].


class BenchController(Protocol):
    """A controller that runs open loop: it starts each tick at the positions that it returned in the last tick."""

    name: str
    limitations: str  # The parts of our contract that this controller cannot keep, in a few words.

    def reset(self, q: Array) -> None:
        """Start at rest at the posture ``q`` (nv,) [rad], in the order of ``Robot.joint_names``."""

    def step(self, targets: Mapping[str, pin.SE3], dt: float) -> tuple[Array, Array]:
        """Compute one tick of ``dt`` [s]. Return positions (nv,) [rad] and velocities (nv,) [rad/s].

        ``targets`` are the target poses of the tools in the world, by arm. Without a solution, an exception is raised.
        """

    def hold(self) -> tuple[Array, Array]:
        """Return the last positions (nv,) [rad] and zero velocities (nv,), as the result of a tick that failed."""


class PeerSettings:
    """Our settings in the units of the peers, for ticks of ``dt`` [s].

    Gains are per tick, and limits are reduced by our margins.
    """

    def __init__(self, robot: Robot, config: Config, dt: float) -> None:
        control = config.control
        self.robot, self.config, self.dt = robot, config, dt
        self.position_gain = control.position_gain * dt  # Share of the tool's position error that a tick removes.
        self.posture_gain = control.posture_gain * dt  # Share of the posture error that a tick removes.
        self.posture_cost = float(control.posture_weight**0.5)  # A tool's cost is 1. A weight is the square of a cost.
        self.velocity = robot.velocity_limit * control.velocity_scale  # (nv,) [rad/s]
        self.acceleration = robot.capped_acceleration(control.acceleration_limit)  # (nv,) [rad/s^2]
        self.lower = robot.position_lower + control.position_margin  # (nv,) [rad]
        self.upper = robot.position_upper - control.position_margin  # (nv,) [rad]
        # The smallest distance that our controller keeps for any pair [m]. Peers have only one distance for all pairs.
        # With the smallest distance, peers may take all postures that our controller may take.
        self.min_distance = float(kept_distances(robot, control).values.min(initial=control.min_distance))
        home = compose(config).home.items()
        # Home positions of joints that move no tool, such as fingers.
        self.home_of_others = {name: value for name, value in home if name not in robot.joint_names}


def make_peer(name: str, setup: PeerSettings) -> BenchController:
    """Build the peer that has this ``name`` in ``PEERS``. Raises any exception of its package."""
    module = importlib.import_module(f"q2r2_control.benchmark.peers.{PEERS[name]}")
    peer: BenchController = getattr(module, PEERS[name].capitalize())(setup, name)
    return peer


def is_installed(name: str) -> bool:
    """Return whether a peer's package can be found."""
    return importlib.util.find_spec(PEERS[name]) is not None


def build_peers(names: Sequence[str], setup: PeerSettings) -> tuple[list[BenchController], list[str]]:
    """Return the peers that can be built, and one line of text for each of the ``names``.

    The line has the limitations of the peer, or the reason why the peer is missing.
    """
    peers, notes = list[BenchController](), list[str]()
    for name in names:
        if not is_installed(name):
            notes.append(f"{name}: not installed; {INSTALL}")
            continue
        try:
            peers.append(make_peer(name, setup))
            notes.append(f"{name}: {peers[-1].limitations}")
        except Exception as error:  # Another version of a package can raise any exception.
            notes.append(f"{name}: cannot be built for this cell: {type(error).__name__}: {error}")
    return peers, notes


class Leading:
    """A peer that gets targets from farther ahead on their paths, to compensate for the peer's lag."""

    def __init__(self, peer: BenchController, gain: float) -> None:
        """Wrap ``peer``. Its tools follow their targets with this ``gain`` [1/s], so their lag is 1 / gain [s]."""
        self.name, self.limitations = peer.name, peer.limitations
        self._peer, self._gain = peer, gain
        self._last: Mapping[str, pin.SE3] = {}

    def reset(self, q: Array) -> None:
        self._last = {}
        self._peer.reset(q)

    def step(self, targets: Mapping[str, pin.SE3], dt: float) -> tuple[Array, Array]:
        """Compute the peer's tick. Each target is first moved on for 1 / gain [s], at its speed since the last tick."""
        before, self._last = self._last or targets, targets
        share, ahead = 1.0 / (self._gain * dt), {}
        for arm, pose in targets.items():
            last = before[arm]
            turn = pin.exp3(share * pin.log3(pose.rotation @ last.rotation.T))
            way = share * (pose.translation - last.translation)
            ahead[arm] = pin.SE3(turn @ pose.rotation, pose.translation + way)
        return self._peer.step(ahead, dt)

    def hold(self) -> tuple[Array, Array]:
        return self._peer.hold()
