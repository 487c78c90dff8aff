"""A cell in MuJoCo that lerobot records from and sends actions to, by the door of policies.

Its features have the names and order of ``q2r2 export lerobot``, so a policy that was trained on such a dataset fits.
"""

from __future__ import annotations

from dataclasses import dataclass
from threading import Event, Thread
from typing import Any

from lerobot.robots import Robot, RobotConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from q2r2_control.config.cell import load_config
from q2r2_control.errors import Q2R2Error
from q2r2_control.inputs.policy import ActionSpace, PolicyInput, action_names
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.plants.mujoco_cameras import CellPictures
from q2r2_control.robot.robot import Robot as CellRobot

_BEGINS = 60.0  # how long the kernels of a new version take to compile at most, and more [s]


@RobotConfig.register_subclass("q2r2_cell")
@dataclass(kw_only=True)
class Q2R2CellConfig(RobotConfig):
    cell: str = "config/dual_iiwa7.yaml"  # a cell's YAML, here or shipped; its cameras are the robot's
    rate: float = 30.0  # of the actions [Hz]


class Q2R2Cell(Robot):
    """Joint positions [rad] and openings, 0 closed .. 1 open. A loop of q2r2 runs from ``connect`` to ``disconnect``.

    Actions that are refused move nothing, and the log says why; the arms rest when none comes for half a second.
    """

    config_class = Q2R2CellConfig
    name = "q2r2_cell"

    def __init__(self, config: Q2R2CellConfig) -> None:
        super().__init__(config)
        self.config = config
        self._cell = load_config(config.cell)
        self.cameras = self._cell.cameras
        self._robot = CellRobot.from_config(self._cell)
        self._plant = MujocoPlant(self._robot, self._cell)
        grippers = tuple(f"{arm}_gripper" for arm in self._robot.arms if arm in self._plant.gripper_openings())
        self._names = (*action_names(self._robot, ActionSpace.JOINTS), *grippers)
        self._policy = PolicyInput(rate=config.rate)
        self._pipeline = Pipeline(self._cell, self._robot, self._policy, self._plant)
        self._pipeline.listeners.append(lambda tick: self._begun.set())
        self._begun = Event()
        self._thread: Thread | None = None
        self._fault: Q2R2Error | None = None
        self._pictures: CellPictures | None = None

    @property
    def observation_features(self) -> dict[str, Any]:
        shapes = {name: (camera.height, camera.width, 3) for name, camera in self.cameras.items()}
        return self.action_features | shapes

    @property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(self._names, float)

    @property
    def is_connected(self) -> bool:
        return self._thread is not None and self._thread.is_alive()

    def connect(self, calibrate: bool = True) -> None:
        if self.is_connected:
            raise DeviceAlreadyConnectedError
        self._begun.clear()
        self._fault = None
        self._thread = Thread(target=self._run, name="q2r2", daemon=True)
        self._thread.start()
        self._begun.wait(_BEGINS)
        self._check()

    def _run(self) -> None:
        try:
            self._pipeline.run()
        except Q2R2Error as error:
            self._fault = error
        finally:
            self._begun.set()

    def _check(self) -> None:
        if not self.is_connected:
            raise DeviceNotConnectedError(f"{self}: {self._fault or 'not connected'}")

    @property
    def is_calibrated(self) -> bool:
        return True

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def get_observation(self) -> dict[str, Any]:
        self._check()
        observation = self._policy.observation
        assert observation is not None
        values = (*observation.state.q, *observation.openings.values())
        seen: dict[str, Any] = dict(zip(self._names, map(float, values), strict=True))
        if self.cameras:
            self._pictures = self._pictures or CellPictures(self._plant.model, self.cameras)
            self._pictures.place(self._plant.observed_qpos)
            seen |= {name: self._pictures.take(name) for name in self.cameras}
        return seen

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        self._check()
        self._policy.send([float(action[name]) for name in self._names], names=self._names)
        return action

    def disconnect(self) -> None:
        self._check()
        assert self._thread is not None
        self._pipeline.stop()
        self._thread.join()
