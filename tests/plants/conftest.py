"""A cell with one block on a post between the left fingers, and commands that move its arms."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.cell import Config, MujocoConfig, ObjectConfig, ObstacleConfig
from q2r2_control.config.cell_file import load_config
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Command, CommandMode


@pytest.fixture(scope="session")
def config() -> Config:
    return load_config("config/dual_iiwa7.yaml")


@pytest.fixture(scope="session")
def shared_plant(robot: Robot, config: Config) -> MujocoPlant:
    return MujocoPlant(robot, config)


@pytest.fixture
def plant(shared_plant: MujocoPlant) -> MujocoPlant:
    shared_plant.reset()
    return shared_plant


@pytest.fixture(scope="session")
def grasping_config(config: Config, robot: Robot) -> Config:
    """Return the cell with a block between the left fingers at home, on a post that ends below them."""
    x, y, z = robot.tool_pose(robot.home, "left").translation
    height = z - 0.03
    return config.model_copy(
        update={
            "obstacles": {"post": ObstacleConfig(shape="box", size=(0.03, 0.03, height), position=(x, y, height / 2))},
            "mujoco": MujocoConfig(
                objects={"block": ObjectConfig(size=(0.04, 0.04, 0.06), position=(x, y, z), mass=0.2)},
            ),
        }
    )


@pytest.fixture(scope="session")
def grasping_robot(grasping_config: Config) -> Robot:
    return Robot.from_config(grasping_config)


@pytest.fixture
def grasping_plant(grasping_robot: Robot, grasping_config: Config) -> MujocoPlant:
    return MujocoPlant(grasping_robot, grasping_config)


def hold(q: Array, **grippers: float) -> Command:
    """Return a command to rest at ``q``."""
    return Command(CommandMode.POSITION, q, np.zeros_like(q), np.zeros_like(q), grippers)


def tool_motion(robot: Robot, arm: str, velocity: Array, duration: float, dt: float, q: Array) -> Iterator[Command]:
    """Return commands that move one tool straight, without rotation, with a gentle start and end at rest."""
    data, chain = robot.model.createData(), robot.arms[arm]
    q = q.copy()
    ticks = round(duration / dt)
    for tick in range(1, ticks + 1):
        speed = min(1.0, tick * dt / 0.2, (ticks - tick) * dt / 0.2)
        pin.computeJointJacobians(robot.model, data, q)
        jacobian = pin.getFrameJacobian(robot.model, data, chain.frame_id, pin.LOCAL_WORLD_ALIGNED)[:, chain.joints]
        v = np.zeros_like(q)
        v[chain.joints] = np.linalg.pinv(jacobian) @ np.concatenate([speed * np.asarray(velocity), np.zeros(3)])
        q = q + v * dt
        yield Command(CommandMode.POSITION, q, v, np.zeros_like(q), {})
