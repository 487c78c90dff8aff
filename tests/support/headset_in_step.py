"""An operator whose headset sends over TCP in simulated time. When a tick polls its input, all data have arrived.

Results therefore do not depend on the speed of the machine. A script is a generator that changes the operator and
yields the times to wait [s]. The run ends with the script.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping

import numpy as np
import pinocchio as pin

from q2r2_control.events import Event
from q2r2_control.inputs.headset import HeadsetServer, watch_of
from q2r2_control.inputs.way_points import minimum_jerk
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.summary.tick import Tick
from q2r2_control.types import QUEST_CONTROLS, SIDES, Array, CommandMode, HandSample, HapticFeedback
from tests.support.fake_headset import FakeHeadset
from tests.support.headset_server import eventually
from tests.support.processes import Watch, cell
from tests.support.reasons import kinds

START = {"left": (0.3, 0.2, 1.1), "right": (0.3, -0.2, 1.1)}  # Positions of the hands [m].
PERIOD = 1.0 / 72.0  # Period of samples [s].
PRESS = 0.12  # Duration of a press [s]. It is longer than the window of a chord.
NOISE = 2e-5  # Noise of a position [m].
_PATIENCE = 60.0  # Longest wait in real time [s].
_AT_REST = 0.5  # Time in which a released arm comes to rest [s].
_CREEP = 1e-5  # Largest distance of a stopped tool from the position at which it stopped [m].
_FASTEST, _FASTEST_TURN = 2.0, 8.0  # Largest speed [m/s] and angular speed [rad/s] of a target.

Script = Callable[["Operator"], Iterator[float]]
Sender = Callable[[str, Array, Array], bytes | None]  # The arguments are hand, position and quaternion.


class Operator:
    """The operator, whose hands and buttons the script changes.

    ``hands`` are the poses of the hands in a frame that the script can move. ``frame`` is the pose of this frame, as
    the headset measures it.
    """

    def __init__(self, server: HeadsetServer, plant: MujocoPlant) -> None:
        self.plant = plant
        self.hands = {hand: pin.SE3(np.eye(3), np.array(START[hand])) for hand in SIDES}
        self.frame = pin.SE3.Identity()
        self.lower: set[str] = set()
        self.upper: set[str] = set()
        self.grip: set[str] = set()
        self.period = PERIOD
        self.silent = False
        self.held_up = False  # If True, the network holds messages, and later delivers all of them at once in order.
        self.send_pose: Sender = self.pose
        self.noise = NOISE
        self.headset: FakeHeadset | None = None
        self.now = 0.0
        self._server = server
        self._backlog: list[bytes] = []
        self._random = np.random.default_rng(5)

    def connect(self) -> None:
        self.headset = FakeHeadset(self._server.address, connect_timeout=_PATIENCE)
        self.headset.send(self.headset.registrations())
        self.headset.read_until("__topic_list", _PATIENCE)

    def pose(self, hand: str, position: Array, quaternion: Array, stamp: tuple[int, int] = (12, 500)) -> bytes:
        """Return the bytes of a pose."""
        assert self.headset is not None
        x, y, z = position.tolist()
        qx, qy, qz, qw = quaternion.tolist()
        return self.headset.pose(hand, (x, y, z), (qx, qy, qz, qw), stamp=stamp)

    def send(self) -> None:
        """Send both hands' poses and buttons, and return when the server has read them."""
        if self.headset is None or self.silent:
            return
        frames = []
        for hand in SIDES:
            seen = self.frame * self.hands[hand]
            position = seen.translation + self._random.normal(0.0, self.noise, 3)
            frames.append(self.send_pose(hand, position, pin.Quaternion(seen.rotation).coeffs()) or b"")
            analog = (0.0, 0.0, 0.0, float(hand in self.grip))
            frames.append(self.headset.inputs(hand, hand in self.upper, hand in self.lower, analog))
        self._backlog += frames
        if not self.held_up:
            self.headset.send(b"".join(self._backlog))
            self._backlog.clear()
            self.wait_until_read()

    def lose(self, end: Callable[[FakeHeadset], None]) -> None:
        """End the connection with the function ``end``, and wait until the server has noticed the loss."""
        assert self.headset is not None
        end(self.headset)
        self.headset = None
        eventually(lambda: self._server.statistics.peer is None)

    def wait_until_read(self) -> None:
        """Wait until the server has read all messages. It answers in order, so one more answer shows this."""
        assert self.headset is not None
        self.headset.send(self.headset.command("__topic_list"))
        self.headset.read_until("__topic_list", _PATIENCE)

    def press(self, *hands: str) -> Iterator[float]:
        """Press the lower buttons of ``hands``. A press engages a paused arm, and pauses an engaged arm."""
        self.lower |= set(hands)
        yield PRESS
        self.lower -= set(hands)
        yield PRESS

    def engage(self) -> Iterator[float]:
        yield 0.1
        yield from self.press(*SIDES)

    def move(
        self, way: Iterable[float], turn: Iterable[float] = (0.0, 0.0, 0.0), seconds: float = 0.6
    ) -> Iterator[float]:
        """Move both hands by ``way`` [m] and ``turn`` [rad], as smoothly as people reach for something.

        The right hand moves by 0.9 of these amounts, because two human hands never move exactly alike.
        """
        steps, starts = max(round(seconds / PERIOD), 1), dict(self.hands)
        whole = pin.Motion(np.array(list(way)), np.array(list(turn)))
        for index in range(1, steps + 1):
            done = minimum_jerk(index / steps)
            for hand, share in (("left", done), ("right", 0.9 * done)):
                rotation = pin.exp3(share * whole.angular) @ starts[hand].rotation
                self.hands[hand] = pin.SE3(rotation, starts[hand].translation + share * whole.linear)
            yield PERIOD


class HeadsetInStep:
    """The input of a run: the server, and the operator whom the script controls."""

    controls = QUEST_CONTROLS

    def __init__(self, script: Script, mujoco: Mapping[str, object], **teleop: object) -> None:
        changed = cell().teleop.model_validate({**cell().teleop.model_dump(), **teleop})
        softer = cell().mujoco.model_copy(update=mujoco)
        self.config = cell().model_copy(update={"teleop": changed, "mujoco": softer, "loop_rate_hz": 500.0})
        self.server = HeadsetServer(port=0, clock=lambda: self.now, watch=watch_of(self.config))
        self.now = 0.0
        self.over = False
        self.plant: MujocoPlant | None = None
        self._make = script

    @property
    def connected(self) -> bool:
        return self.server.connected

    def start(self) -> None:
        self.server.start()
        assert self.plant is not None
        self.operator = Operator(self.server, self.plant)
        self.operator.connect()
        self._script = self._make(self.operator)
        self._wakes = self._sends = 0.0

    def poll(self, now: float) -> list[HandSample]:
        self.now = self.operator.now = now
        while not self.over and now >= self._wakes - 1e-9:
            try:
                self._wakes += next(self._script)
            except StopIteration:
                self.over = True
        if now >= self._sends - 1e-9:
            self._sends += self.operator.period
            self.operator.send()
        return self.server.poll(now)

    def send_haptic(self, feedback: HapticFeedback) -> None:
        self.server.send_haptic(feedback)

    def close(self) -> None:
        if self.operator.headset is not None:
            self.operator.headset.close()
        self.server.close()


class InStepRun:
    """A complete run of a script. Each tick must keep the contract, and pass the check :class:`NoCatchUp`."""

    def __init__(
        self,
        script: Script,
        mujoco: Mapping[str, object] | None = None,
        mode: CommandMode = CommandMode.POSITION,
        **teleop: object,
    ) -> None:
        self.source = HeadsetInStep(script, mujoco or {}, **teleop)
        self.loop = Pipeline.from_config(self.source.config, input=self.source, plant="mujoco", mode=mode)
        assert isinstance(self.loop.plant, MujocoPlant)
        self.source.plant = self.loop.plant
        self.watch = Watch(self.loop)
        self.loop.listeners.append(NoCatchUp(self.loop))
        self.loop.listeners.append(self._end)
        self.summary = self.loop.run(120.0, realtime=False)
        assert self.source.over, "the script was played to its end"

    def _end(self, tick: Tick) -> None:
        if self.source.over:
            self.loop.stop()

    @property
    def ticks(self) -> list[Tick]:
        """Return the ticks until the script ends. The later ticks, in which the arms come to rest, are left out."""
        return [tick for tick in self.watch.ticks if tick.following]

    def tool(self, arm: str) -> Array:
        """Return the measured positions of a tool at every tick (n, 3) [m]."""
        return np.array([tick.tools[arm].translation for tick in self.ticks])

    @property
    def states(self) -> set[str]:
        """Return the states of both arms at the end of the script."""
        return set(self.ticks[-1].states.values())

    @property
    def events(self) -> list[Event]:
        return [event for tick in self.ticks for event in tick.events]

    def reasons(self, destination: str) -> list[str]:
        """Return the kinds of the reasons for which an arm got into the state ``destination``, or refused a press."""
        return [kinds(event.reason) for event in self.events if event.destination == destination]


class NoCatchUp:
    """A check that fails a run in which an arm moves without engagement, or a target jumps."""

    def __init__(self, loop: Pipeline) -> None:
        self._robot = loop.robot
        self._data = loop.robot.model.createData()
        self._before: dict[str, pin.SE3] = {}
        self._let_go = dict.fromkeys(SIDES, -math.inf)
        self._rests: dict[str, Array] = {}

    def __call__(self, tick: Tick) -> None:
        if not tick.following:
            return
        pin.forwardKinematics(self._robot.model, self._data, tick.reference.q)
        for name, arm in self._robot.arms.items():
            place = pin.updateFramePlacement(self._robot.model, self._data, arm.frame_id).translation.copy()
            target = tick.targets[name].pose
            if tick.engaged[name]:
                assert target is not None
                self._check_target(name, target, tick)
                self._let_go[name] = tick.t
                self._rests.pop(name, None)
                continue
            assert target is None, f"{name} has a target without being engaged, at {tick.t:.3f} s"
            self._before.pop(name, None)
            if tick.t - self._let_go[name] > _AT_REST:
                rest = self._rests.setdefault(name, place)
                assert math.dist(place, rest) < _CREEP, f"{name} moves without being engaged, at {tick.t:.3f} s"

    def _check_target(self, name: str, target: pin.SE3, tick: Tick) -> None:
        before = self._before.get(name)
        if before is None:
            off = math.dist(target.translation, tick.tools[name].translation)
            assert off < 1e-9, f"{name} is engaged {off:.3g} m off its tool, at {tick.t:.3f} s"
        else:
            way = math.dist(target.translation, before.translation)
            assert way < _FASTEST * tick.dt, f"the target of {name} jumps by {way:.3g} m, at {tick.t:.3f} s"
            angle = float(np.linalg.norm(pin.log3(before.rotation.T @ target.rotation)))
            assert angle < _FASTEST_TURN * tick.dt, f"the target of {name} turns by {angle:.3g} rad, at {tick.t:.3f} s"
        self._before[name] = target
