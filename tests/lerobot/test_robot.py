"""A cell is a robot of lerobot. It is found by its name, has the features of the datasets, and follows actions.

Run by ``make test-lerobot``, in an environment of its own.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

pytest.importorskip("lerobot", reason="make test-lerobot installs it")
pytest.importorskip("lerobot_robot_q2r2", reason="make test-lerobot installs it")

from lerobot.robots import Robot, RobotConfig, make_robot_from_config
from lerobot.utils.errors import DeviceNotConnectedError
from lerobot.utils.import_utils import register_third_party_plugins

from q2r2_control.export.episodes import FrameSampling, make_episode
from q2r2_control.export.lerobot import write_shard
from q2r2_control.recording.reader import Recording, recordings_in
from tests.cameras.videos import FPS, HEIGHT, WIDTH, number_in, number_of_jpeg, write_video
from tests.export.files import record_step
from tests.lerobot.test_commands import write_cell
from tests.plants.fri.conftest import free_ports
from tests.recording.runs import ROOT
from tests.ros.processes import EXECUTABLES, as_arguments, environment_of

register_third_party_plugins()
# MOVED: required motion of a joint [rad]. NEAR: tolerance of a joint [rad] and of an opening, which is 0 to 1.
# TRIES: number of tries. Each try takes at least 1/30 s.
MOVED, NEAR, TRIES = 0.02, 0.004, 1800
ROS_RATE = 200.0  # [Hz]


def made(folder: Path, **options: Any) -> Robot:
    (without_cameras := folder / "without_cameras").mkdir(exist_ok=True)
    options.setdefault("cell", str(write_cell(without_cameras, {})))
    return make_robot_from_config(RobotConfig.get_choice_class("q2r2_cell")(calibration_dir=folder / "none", **options))


def assert_follows(robot: Robot) -> None:
    """Assert that one joint and one gripper reach what actions ask for, however long the machine takes."""
    start = robot.get_observation()
    moved = {"left_A1.pos": start["left_A1.pos"] + MOVED, "right_gripper.pos": 0.5}
    goal = start | moved
    for _ in range(TRIES):
        robot.send_action(goal)
        seen = robot.get_observation()
        if all(abs(seen[name] - goal[name]) < NEAR for name in moved):
            return
        time.sleep(1.0 / 30.0)
    pytest.fail(str({name: seen[name] for name in moved}))


def test_a_cell_has_the_features_of_its_datasets_and_follows_actions(tmp_path: Path) -> None:
    robot = made(tmp_path)
    write_shard(make_episode(record_step(tmp_path / "recording", 0.3).file, FrameSampling()), tmp_path / "dataset")
    features = json.loads((tmp_path / "dataset/meta/info.json").read_text())["features"]
    for name, given in (("observation.state", robot.observation_features), ("action", robot.action_features)):
        assert features[name]["names"] == list(given)
        assert set(given.values()) == {float}
    with pytest.raises(DeviceNotConnectedError):
        robot.get_observation()
    robot.connect()
    try:
        assert_follows(robot)
    finally:
        robot.disconnect()
    assert not robot.is_connected


def test_pictures_of_a_real_camera_are_observed_and_recorded_until_it_stops(tmp_path: Path) -> None:
    count, enough = 200, 12
    video = write_video(tmp_path / "front.avi", range(count))
    camera = {"device": str(video), "width": WIDTH, "height": HEIGHT, "rate": FPS}
    changes = {"plant: mujoco": "plant: kinematic", "loop_rate_hz: auto": f"loop_rate_hz: {ROS_RATE}"}
    cell = write_cell(tmp_path, changes, json.dumps({"front": camera}))
    robot = made(tmp_path, cell=str(cell), record=str(tmp_path / "recordings"))
    assert robot.observation_features["front"] == (HEIGHT, WIDTH, 3)
    seen: list[int] = []

    def look() -> None:
        while True:
            if (number := number_in(robot.get_observation()["front"])) not in seen[-1:]:
                seen.append(number)
            process = robot.pipeline.cameras.streams["front"].process
            if len(seen) >= enough:
                with suppress(ProcessLookupError):
                    os.kill(process.pid, signal.SIGKILL)
            time.sleep(0.01)

    robot.connect()
    try:
        with pytest.raises(DeviceNotConnectedError, match=r"camera front: no picture for .* s: .* SIGKILL"):
            look()
    finally:
        robot.disconnect()
    (recording,) = recordings_in([tmp_path / "recordings"])
    numbers = [number_of_jpeg(picture.jpeg) for picture in Recording(recording).pictures("front")]
    np.testing.assert_array_equal(numbers, (numbers[0] + np.arange(len(numbers))) % count)
    np.testing.assert_array_equal([number for number in numbers if number in seen], seen[-len(numbers) :])


def test_in_simulated_time_a_robot_has_no_real_cameras(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    cell = write_cell(tmp_path, {}, "{front: {device: 0}}")
    robot = made(tmp_path, cell=str(cell), simulated_time=True)
    assert "front" not in robot.observation_features
    assert "no pictures of front: real cameras keep real time; allowed: simulated_time=false" in caplog.messages


def test_arms_behind_cabinets_follow_actions_like_simulated_arms(tmp_path: Path) -> None:
    data = yaml.safe_load((ROOT / "config/dual_iiwa7_fri.yaml").read_text())
    for arm, port in zip(("left", "right"), free_ports(2), strict=True):
        data["fri"][arm]["port"] = port
    file = tmp_path / "cell.yaml"
    file.write_text(yaml.safe_dump(data))
    robot = made(tmp_path, cell=str(file))
    assert list(robot.observation_features) == list(made(tmp_path).observation_features)
    assert_follows_behind(robot, "q2r2_control", "fri-cabinet", str(file))


def test_arms_behind_ros_also_follow_actions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rclpy", reason="make test-lerobot-ros installs it")
    coordinator = pytest.importorskip("domain_coordinator")
    cell = write_cell(tmp_path, {"loop_rate_hz: auto": f"loop_rate_hz: {ROS_RATE}"})
    node = as_arguments(f"config:={cell}", f"rate:={ROS_RATE}")
    with coordinator.domain_id() as domain:
        for name, value in environment_of(domain, tmp_path).items():
            monkeypatch.setenv(name, value)
        assert_follows_behind(made(tmp_path, cell=str(cell), plant="ros"), EXECUTABLES, "mujoco_robot", *node)


def assert_follows_behind(robot: Robot, module: str, *arguments: str) -> None:
    """Assert that arms behind another program follow. The program is started here, and may take long to start."""
    program = subprocess.Popen([sys.executable, "-m", module, *arguments], cwd=ROOT, env=os.environ)
    try:
        while not robot.is_connected:
            assert program.poll() is None
            with suppress(DeviceNotConnectedError):
                robot.connect()
        assert_follows(robot)
    finally:
        with suppress(DeviceNotConnectedError):
            robot.disconnect()
        program.terminate()
        assert program.wait() == 0
