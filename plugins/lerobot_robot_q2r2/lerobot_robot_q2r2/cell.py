"""A robot for lerobot that drives a cell. lerobot reads its observations and sends it actions, as with other robots.

The features of this robot have the same names and order as the features of a dataset from ``q2r2 export lerobot``.
Therefore a policy that was trained on such a dataset can drive this robot.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Thread
from typing import Any, ClassVar

from lerobot.robots import Robot, RobotConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from lerobot_robot_q2r2.hands import HandsDoor
from q2r2_control import (
    ActionSpace,
    CameraError,
    ConfigError,
    Pipeline,
    PolicyInput,
    Q2R2Error,
    Tick,
    action_names,
    load_commissioned,
)
from q2r2_control.cameras import CameraStreams
from q2r2_control.export import POSITION
from q2r2_control.plants import CellPictures, MujocoPlant
from q2r2_control.recording import About, DevicePictures, Recorder

_logger = logging.getLogger(__name__)
_ROOM = 64 << 20  # Largest total size of the pictures and ticks that wait to be written [bytes].
# Longest time to wait for the first tick [s]. It is longer than the compilation of the kernels of a new version takes.
_BEGINS = 60.0


@RobotConfig.register_subclass("q2r2_cell")
@dataclass(kw_only=True)
class Q2R2CellConfig(RobotConfig):
    cell: str = "config/dual_iiwa7.yaml"  # Path of the YAML of any cell. The cameras of this cell are used.
    plant: str | None = None  # Name of an installed plant, such as fri; None for the cell's own plant.
    rate: float = 30.0  # Rate of the actions [Hz].
    simulated_time: bool = False  # If true, time is simulated: it advances by 1 / rate with each action.
    full_speed: bool = False  # If false, real arms move at a tenth of the speed that the cell says.
    record: str | None = None  # Folder for recordings of q2r2; None to record nothing.


class Q2R2Cell(Robot):
    """A cell as a robot of lerobot.

    Its features are joint positions [rad], and openings of grippers, 0 closed .. 1 open.

    A loop of q2r2 runs from ``connect`` to ``disconnect``. If an action is refused, it moves nothing, and the log says
    why. If no action comes for half a second, the arms come to rest.
    """

    config_class = Q2R2CellConfig
    name = "q2r2_cell"
    newest: ClassVar[Q2R2Cell | None] = None  # The cell that was created last. The hands of a teleoperator drive it.

    def __init__(self, config: Q2R2CellConfig) -> None:
        super().__init__(config)
        self.config = config
        self._cell = cell = load_commissioned(config.cell, config.plant, full_speed=config.full_speed)
        self.hands = HandsDoor()
        self._policy = PolicyInput(rate=config.rate, operator=self.hands)
        self.pipeline = Pipeline.from_config(cell, input=self._policy, plant=config.plant)
        if faults := self.pipeline.preflight_faults():
            raise ConfigError(f"{cell.name}: {'; '.join(faults)}")
        self._robot, self._plant = self.pipeline.robot, self.pipeline.plant
        self._drawn = cell.simulated_cameras if isinstance(self._plant, MujocoPlant) else {}
        self._devices = {} if config.simulated_time else cell.device_cameras
        if left_out := ", ".join(cell.device_cameras.keys() - self._devices.keys()):
            _logger.warning("no pictures of %s: real cameras keep real time; allowed: simulated_time=false", left_out)
        self.cameras = self._drawn | self._devices
        joints = action_names(self._robot, ActionSpace.JOINTS)
        self._measured = tuple(arm for arm in self._robot.arms if arm in self._plant.gripper_openings())
        self._seen = (*joints, *(f"{arm}_gripper" for arm in self._measured))
        self._names = (*joints, *(f"{arm}_gripper" for arm in self._robot.arms))  # Names of an action's numbers.
        self.pipeline.listeners.append(self._see)
        self._tick: Tick | None = None  # The newest tick.
        self._begun = Event()
        self._thread: Thread | None = None
        self._fault: Q2R2Error | None = None
        # In simulated time, the number of actions since the start, and the time of the start [s].
        self._steps, self._start = 0, 0.0
        self._pictures: CellPictures | None = None
        self._open = ExitStack()  # The open cameras and the recording.
        Q2R2Cell.newest = self

    @property
    def observation_features(self) -> dict[str, Any]:
        shapes = {name: (camera.height, camera.width, 3) for name, camera in self.cameras.items()}
        return _features(self._seen) | shapes

    @property
    def action_features(self) -> dict[str, Any]:
        return _features(self._names)

    @property
    def is_connected(self) -> bool:
        running = self._thread is not None and self._thread.is_alive()
        return running or (self.config.simulated_time and self._tick is not None)

    def connect(self, calibrate: bool = True) -> None:
        if self.is_connected:
            raise DeviceAlreadyConnectedError
        self._begun.clear()
        self._fault, self.hands.open = None, False
        try:
            self._open_cameras_and_recording()
        except Q2R2Error:
            self._open.close()
            raise
        if self.config.simulated_time:
            self.pipeline.begin()
            self._steps, self._start = 0, self.pipeline.tick().now
            return
        self._thread = Thread(target=self._run, name="q2r2", daemon=True)
        self._thread.start()
        self._begun.wait(_BEGINS)
        self._check()

    def _open_cameras_and_recording(self) -> None:
        realtime, recording = not self.config.simulated_time, None
        streams = self.pipeline.cameras = self._open.enter_context(CameraStreams(self._devices))
        streams.wait_until_ready()
        if self.config.record is not None:
            folder = Path(self.config.record)
            recorder = Recorder(folder, self._cell.name, waits=not realtime, room=_ROOM)
            self._open.enter_context(recorder)
            about = About.of(self.pipeline, realtime, {"cell": self._cell.name}, tuple(self._devices))
            recorder.begin(about, self._robot)
            recording = recorder, about
            self._listen(recorder)
        if self._devices:
            report = self.pipeline.record_outcome
            self._listen(self._open.enter_context(DevicePictures(streams, realtime, report, recording)))

    def _listen(self, listener: Callable[[Tick], None]) -> None:
        self.pipeline.listeners.append(listener)
        self._open.callback(self.pipeline.listeners.remove, listener)

    def _run(self) -> None:
        try:
            self.pipeline.run()
        except Q2R2Error as error:
            self._fault = error
        finally:
            self._open.close()
            self._begun.set()

    def _see(self, tick: Tick) -> None:
        self._tick = tick
        self._begun.set()

    def _check(self) -> Tick:
        if not self.is_connected or self._fault is not None or self._tick is None:
            raise DeviceNotConnectedError(f"{self}: {self._fault or 'not connected'}")
        return self._tick

    @property
    def is_calibrated(self) -> bool:
        return True

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def get_observation(self) -> dict[str, Any]:
        tick = self._check()
        # If a gripper's opening is not measured at present, the commanded opening is used.
        openings = [tick.openings.get(arm, tick.command.grippers[arm]) for arm in self._measured]
        seen = _named(self._seen, (*tick.state.q, *openings))
        if self._drawn:
            assert isinstance(self._plant, MujocoPlant)
            self._pictures = self._pictures or CellPictures(self._plant.model, self._drawn)
            self._pictures.place(self._plant.observed_qpos)
            seen |= {name: self._pictures.take(name) for name in self._drawn}
        if self._devices:
            assert self._policy.observation is not None
            try:
                seen |= {name: self._policy.observation.pictures[name].pixels for name in self._devices}
            except CameraError as error:
                raise DeviceNotConnectedError(f"{self}: {error}") from error
        return seen

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Send an action. An action that does not come from the hands comes from the policy.

        If the hands moved the arms until now, such an action lets the policy take over the arms.
        """
        self._check()
        before, self._by_policy = self._by_policy, not self._asked
        if self._by_policy and self.hands.open:
            self.hands.open = False
            self.pipeline.give_back()
        if not self._asked:
            given = {name.removesuffix(POSITION): value for name, value in action.items()}
            self._policy.send([float(given[name]) for name in self._names], names=self._names)
        self._asked = False
        if self.config.simulated_time:
            self._steps += 1
            try:
                self.pipeline.tick_until(self._start + self._steps / self.config.rate)
            except Q2R2Error as error:
                self._fault = error
        if self._by_policy and not before:
            _logger.info("the policy has the arms")
        return action

    _asked = False  # True if the next action comes from the hands, because lerobot has just called hands_action.
    _by_policy = False  # True if the last action came from the policy.

    def hands_action(self) -> dict[str, Any]:
        """Return the controller's reference as an action.

        From now on the hands move the reference, until the policy sends an action.
        """
        tick = self._check()
        self._asked = self.hands.open = True
        return _named(self._names, (*tick.reference.q, *map(tick.command.grippers.__getitem__, self._robot.arms)))

    def disconnect(self) -> None:
        if self._tick is None:
            raise DeviceNotConnectedError(f"{self}: not connected")
        if self._thread is not None:
            self.pipeline.stop()
            self._thread.join()
            self._thread = None
        self.pipeline.end()
        self._open.close()
        self._tick = None


def _features(names: tuple[str, ...]) -> dict[str, Any]:
    return {f"{name}{POSITION}": float for name in names}


def _named(names: tuple[str, ...], values: tuple[float, ...]) -> dict[str, Any]:
    return {f"{name}{POSITION}": float(value) for name, value in zip(names, values, strict=True)}
