"""One task of the demo in MuJoCo as an environment. Its actions go only through the input for policies."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import pinocchio as pin
from gymnasium.spaces import Box, Dict

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.recording import CameraConfig
from q2r2_control.demo.assembly_tasks import TaskWatch, tasks_named
from q2r2_control.errors import ConfigError, PlantError, shown
from q2r2_control.export.lerobot import video_key
from q2r2_control.export.sampling import continuous
from q2r2_control.extras import importing
from q2r2_control.gym.promises import StepPromises
from q2r2_control.inputs.policy import ActionSpace, PolicyInput, action_names
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.plants.mujoco_cameras import CellPictures
from q2r2_control.robot.robot import Robot
from q2r2_control.robot.unchecked import check_watched
from q2r2_control.types import Array, is_number

with importing("sim", "an environment"):
    import mujoco

CELL = "config/dual_iiwa7.yaml"
_FRONT = CameraConfig(position=(1.9, 0.0, 1.0), look_at=(0.4, 0.0, 0.3), width=320, height=240)
_LARGEST_COORDINATE = 2.0  # The largest absolute coordinate of a tool in the world, for the space of actions [m].

_LOOP_RATES = 50.0, 1000.0  # The lowest and the highest rate of the control loop [Hz].

Observed = dict[str, npt.NDArray[Any]]


class TaskEnv(gymnasium.Env):
    """A task of :data:`q2r2_control.demo.assembly_tasks.TASKS`. The reward is 1 when its judge reports success, else 0.

    Observations and actions have the numbers of the datasets' features, in their order. ``action_names`` has the names
    of the numbers of the ``space``, followed by the openings of grippers. An action is followed for 1 / ``rate`` [s],
    and the observation after n steps is frame n of a dataset at this rate. An untrained agent can move the arms in the
    default space, ``action.tool_delta``. In the other spaces, the agent would command jumps, which are refused.

    ``spread`` [m] is the largest random offset of the task's parts, along x and along y; the seed decides it. With
    ``pictures``, observations contain pictures of the cell's simulated cameras. If the cell has none, a camera in front
    of the cell takes them. ``loop_rate`` [Hz] is the rate of the control loop; None stands for the cell's rate. At 100
    Hz, a step of the environment needs a quarter to a third of the computing time that it needs at 1 kHz. The physics
    has the cell's own step at every rate.

    No action breaks a limit or a distance. ``info["promises"]`` describes a step. ``nearest_distance`` [m] is the
    smallest distance of any pair, and ``nearest_pair`` is this pair. ``margin`` [m] is the smallest distance of a pair
    minus its kept distance. ``certified`` is True if all ticks had a certificate. ``held_back`` says why arms or
    grippers did less than was asked, and which limits were reached. ``info["measured"]`` has the judge's figures, and
    ``info["reason"]`` says why the task is not done. A fault that stops the arms ends the episode, with its reason.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012

    def __init__(
        self,
        task: str,
        *,
        cell: Config | Path | str = CELL,
        space: ActionSpace | str = ActionSpace.TOOL_DELTA,
        rate: float = 30.0,
        spread: float = 0.01,
        pictures: bool = False,
        render_mode: str | None = None,
        loop_rate: float | None = None,
    ) -> None:
        """Make the cell and its simulation.

        Raises:
            ConfigError: For an unknown task or space, a ``loop_rate`` that is not allowed, and a cell that lacks a part
                of the task.
        """
        config = cell if isinstance(cell, Config) else load_config(cell)
        if not config.simulated_cameras:
            config = config.model_copy(update={"cameras": {"front": _FRONT}})
        if loop_rate is not None:
            config = _with_loop_rate(config, loop_rate)
        self.render_mode = render_mode
        self._config, self._rate, self._spread, self._pictures = config, rate, spread, pictures
        self.metadata = {**self.metadata, "render_fps": rate}
        self.tasks = tasks_named([task])
        self.task = self.tasks[0].about
        self._robot = Robot.from_config(config)
        check_watched(self._robot, config.name)
        self._plant = MujocoPlant(self._robot, config)
        self._policy = PolicyInput(space=space, rate=rate)
        self._pipeline = Pipeline(config, self._robot, self._policy, self._plant)
        self._camera: CellPictures | None = None
        self._tools: Array | None = (
            None  # Tool poses (arms, 7) of the last observation. The next quaternions get the same signs.
        )
        grippers = tuple(f"{arm}_gripper" for arm in self._robot.arms if arm in self._plant.gripper_openings())
        self.action_names = (*action_names(self._robot, self._policy.space), *grippers)
        self.action_space = self._actions(len(grippers))
        self.observation_space = self._observations(len(grippers))

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """Move both arms home, and put the parts at positions that the seed decides."""
        super().reset(seed=seed)
        self._pipeline.end()
        self._watch = TaskWatch(self.tasks, self._plant, self._robot, self._config)
        self._promises = StepPromises()
        self._pipeline.listeners[:] = [self._watch, self._promises]
        self._pipeline.begin()
        self._scatter()
        self._start = self._pipeline.tick().now
        self._steps, self._tools = 0, None
        return self._observed(), self._info("")

    def step(self, action: npt.ArrayLike) -> tuple[Observed, float, bool, bool, dict[str, Any]]:
        self._policy.send(action, names=self.action_names)
        self._promises.begin()
        self._steps += 1
        fault = ""
        try:
            self._pipeline.tick_until(self._start + self._steps / self._rate)
        except PlantError as error:
            fault = str(error)
        info = self._info(fault)
        done = info["is_success"]
        return self._observed(), float(done), done or bool(fault), False, info

    def render(self) -> npt.NDArray[np.uint8] | None:
        """Return the picture (height, width, 3), r g b, of the first camera; None if ``render_mode`` is None."""
        return None if self.render_mode is None else self._take([next(iter(self._config.simulated_cameras))])[0]

    def close(self) -> None:
        self._pipeline.end()

    def _info(self, fault: str) -> dict[str, Any]:
        (result,) = self._watch.results()
        return {
            "is_success": result.succeeded and not fault,
            "reason": fault or result.reason,
            "measured": result.measured,
            "promises": self._promises.as_info(),
        }

    def _scatter(self) -> None:
        model, data = self._plant.model, self._plant.data
        for part in self.tasks[0].parts:
            at = model.jnt_qposadr[model.body(part).jntadr[0]]
            data.qpos[at : at + 2] += self.np_random.uniform(-self._spread, self._spread, 2)
        mujoco.mj_forward(model, data)

    def _observed(self) -> Observed:
        observation = self._policy.observation
        assert observation is not None
        state = observation.state
        poses = np.array([[pin.SE3ToXYZQUAT(tool) for tool in observation.tools.values()]])
        self._tools = tools = continuous(poses, self._tools)[0]
        seen = {
            "observation.state": np.hstack((state.q, list(observation.openings.values()))),
            "observation.velocity": state.v,
            "observation.effort": state.tau,
            "observation.tool": tools.ravel(),
        }
        made: Observed = {name: values.astype(np.float32) for name, values in seen.items()}
        if self._pictures:
            cameras = list(self._config.simulated_cameras)
            made |= zip(map(video_key, cameras), self._take(cameras), strict=True)
        return made

    def _take(self, cameras: list[str]) -> list[npt.NDArray[np.uint8]]:
        self._camera = self._camera or CellPictures(self._plant.model, self._config.simulated_cameras)
        self._camera.place(self._plant.observed_qpos)
        return [self._camera.take(camera) for camera in cameras]

    def _actions(self, grippers: int) -> Box:
        robot, gate = self._robot, self._config.teleop.gate
        if self._policy.space is ActionSpace.JOINTS:
            low, high = robot.position_lower, robot.position_upper
        elif self._policy.space is ActionSpace.TOOL:
            high = np.tile([_LARGEST_COORDINATE] * 3 + [1.0] * 4, len(robot.arms))
            low = -high
        else:  # The largest allowed motion from one action to the next.
            most = min(gate.max_jump, gate.max_speed / self._rate) / math.sqrt(3.0)
            most_angle = min(gate.max_rotation_jump, gate.max_angular_speed / self._rate) / math.sqrt(3.0)
            high = np.tile([most] * 3 + [most_angle] * 3, len(robot.arms))
            low = -high
        return Box(
            np.hstack((low, np.zeros(grippers))).astype(np.float32),
            np.hstack((high, np.ones(grippers))).astype(np.float32),
        )

    def _observations(self, grippers: int) -> Dict:
        joints = len(self._robot.joint_names)
        sizes = {"state": joints + grippers, "velocity": joints, "effort": joints, "tool": 7 * len(self._robot.arms)}
        spaces: dict[str, Box] = {f"observation.{name}": Box(-np.inf, np.inf, (size,)) for name, size in sizes.items()}
        if self._pictures:
            shapes = {name: (camera.height, camera.width, 3) for name, camera in self._config.simulated_cameras.items()}
            spaces |= {video_key(name): Box(0, 255, shape, np.uint8) for name, shape in shapes.items()}
        return Dict(spaces)


def _with_loop_rate(config: Config, rate: float) -> Config:
    """Return the cell with another ``rate`` of its loop [Hz]. The controller does not split its ticks into substeps."""
    if not is_number(rate) or not _LOOP_RATES[0] <= rate <= _LOOP_RATES[1]:
        raise ConfigError(f"loop_rate = {shown(rate)}: allowed: {_LOOP_RATES[0]:g} to {_LOOP_RATES[1]:g} Hz, or None")
    control = config.control.model_copy(update={"max_substep": max(config.control.max_substep, 1.0 / rate)})
    return config.model_copy(update={"loop_rate_hz": float(rate), "control": control})
