"""A cell is a robot of lerobot: found by its name, with the features of the datasets, moved by its actions.

Run by ``make test-lerobot``, in an environment of its own.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest

pytest.importorskip("lerobot", reason="make test-lerobot installs it")
pytest.importorskip("lerobot_robot_q2r2", reason="make test-lerobot installs it")

from lerobot.robots import RobotConfig, make_robot_from_config
from lerobot.utils.errors import DeviceNotConnectedError
from lerobot.utils.feature_utils import hw_to_dataset_features
from lerobot.utils.import_utils import register_third_party_plugins

from q2r2_control.export.episodes import FrameSampling, make_episode
from q2r2_control.export.lerobot import write_shard
from tests.export.files import record_step

register_third_party_plugins()
MOVED, NEAR, PATIENCE = 0.02, 0.004, 60.0  # [rad], [rad] or of an opening, [s]


def test_a_cell_has_the_features_of_its_datasets_and_follows_actions(tmp_path: Path) -> None:
    config = RobotConfig.get_choice_class("q2r2_cell")(calibration_dir=tmp_path / "none")
    robot = make_robot_from_config(config)
    write_shard(make_episode(record_step(tmp_path / "recording", 0.3).file, FrameSampling()), tmp_path / "dataset")
    features = json.loads((tmp_path / "dataset/meta/info.json").read_text())["features"]
    for prefix, given in (("observation", robot.observation_features), ("action", robot.action_features)):
        for name, feature in hw_to_dataset_features(given, prefix).items():
            assert features[name]["names"] == feature["names"]
            assert features[name]["dtype"] == feature["dtype"]
    with pytest.raises(DeviceNotConnectedError):
        robot.get_observation()
    robot.connect()
    try:
        start = robot.get_observation()
        moved = {"left_A1.pos": start["left_A1.pos"] + MOVED, "right_gripper.pos": 0.5}
        goal, until = start | moved, time.monotonic() + PATIENCE
        while time.monotonic() < until:
            robot.send_action(goal)
            seen = robot.get_observation()
            if all(abs(seen[name] - goal[name]) < NEAR for name in moved):
                break
            time.sleep(1.0 / 30.0)
        else:
            pytest.fail(str({name: seen[name] for name in moved}))
    finally:
        robot.disconnect()
    assert not robot.is_connected
