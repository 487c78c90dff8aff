"""Every shipped cell loads, and the first of them shows with comments all that there is to tune."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

import pytest
import yaml
from pydantic import BaseModel

from q2r2_control.config.arms import (
    ArmConfig,
    FlangeConfig,
    GripperConfig,
    HeldObjectConfig,
    PoseConfig,
    RobotConfig,
    SwivelConfig,
    ToolConfig,
)
from q2r2_control.config.bindings import BindingSettings
from q2r2_control.config.cameras import CameraConfig
from q2r2_control.config.cell import (
    Config,
    HeadsetConfig,
    MujocoConfig,
    ObjectConfig,
    ObstacleConfig,
    load_config,
)
from q2r2_control.config.control import (
    AdmittanceSettings,
    ContactPair,
    ControllerSettings,
    DistanceSettings,
    ImpedanceSettings,
    NamedPairDistance,
    WallSettings,
)
from q2r2_control.config.external import ExternalArm, ExternalConfig, ExternalGripper, GuardLimits
from q2r2_control.config.judge import JudgeSettings
from q2r2_control.config.supervision import SupervisionSettings
from q2r2_control.config.teleop import (
    FilterSettings,
    GateSettings,
    HapticSettings,
    LeashSettings,
    TeleopSettings,
    WorkspaceSettings,
)
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.robot import Robot
from tests.config.cell_files import CELL, SHIPPED, changed
from tests.support.external_cell import external_text, robot_text


@pytest.mark.parametrize("file", sorted(SHIPPED.glob("*.yaml")), ids=lambda file: file.stem)
def test_every_shipped_cell_loads_and_composes(file: Path) -> None:
    config = load_config(file)
    assert config.name == file.stem
    assert Robot.from_config(config).model.nv == 14


class TestTheShippedCellShowsAllThereIsToTune:
    # Models at every place where they occur, each with one example of it in the file.
    PLACES: tuple[tuple[str, type[BaseModel]], ...] = (
        ("", Config),
        ("robot", RobotConfig),
        ("arms.left", ArmConfig),
        ("arms.left.mount", PoseConfig),
        ("arms.left.flange", FlangeConfig),
        ("arms.left.tool", ToolConfig),
        ("arms.left.gripper", GripperConfig),
        ("arms.left.swivel", SwivelConfig),
        ("obstacles.table", ObstacleConfig),
        ("supervision", SupervisionSettings),
        ("headset", HeadsetConfig),
        ("control", ControllerSettings),
        ("control.distances", DistanceSettings),
        ("impedance", ImpedanceSettings),
        ("impedance.wall", WallSettings),
        ("admittance", AdmittanceSettings),
        ("teleop", TeleopSettings),
        ("teleop.filter", FilterSettings),
        ("teleop.leash", LeashSettings),
        ("teleop.haptics", HapticSettings),
        ("teleop.bindings", BindingSettings),
        ("teleop.gate", GateSettings),
        ("mujoco", MujocoConfig),
        ("mujoco.objects.blue_block", ObjectConfig),
        ("judge", JudgeSettings),
        ("external", ExternalConfig),
        ("external.limits", GuardLimits),
        ("external.arms.left", ExternalArm),
        ("external.arms.left.gripper", ExternalGripper),
    )
    # Not the default, and the file says so.
    CHOSEN = ("control.solve_time_limit", "control.distances", "mujoco.objects")
    IN_A_COMMENT = (
        CameraConfig,
        ContactPair,
        HeldObjectConfig,
        NamedPairDistance,
        WorkspaceSettings,
    )
    # A tool's mount and an obstacle's rpy are placements as an arm's mount is, which shows the keys.
    SHOWN_ELSEWHERE = ("arms.left.tool.mount", "obstacles.table.rpy")

    def test_no_model_was_forgotten_here(self) -> None:
        known = {model for _, model in self.PLACES} | set(self.IN_A_COMMENT)
        found: set[type[BaseModel]] = set()

        def visit(annotation: object) -> None:
            for inner in get_args(annotation):
                visit(inner)
            if isinstance(annotation, type) and issubclass(annotation, BaseModel) and annotation not in found:
                found.add(annotation)
                for field in annotation.model_fields.values():
                    visit(field.annotation)

        visit(Config)
        assert found == known

    @pytest.mark.parametrize(("place", "model"), PLACES, ids=lambda value: value if isinstance(value, str) else "")
    def test_every_key_is_written_and_commented(self, place: str, model: type[BaseModel]) -> None:
        text = robot_text() if place == "robot" else external_text()
        data, lines = yaml.safe_load(text), text.splitlines()
        for part in filter(None, place.split(".")):
            data = data[part]
        for key in model.model_fields:
            path = f"{place}.{key}".lstrip(".")
            if path in self.SHOWN_ELSEWHERE:
                continue
            assert key in data, path
            if not isinstance(data[key], dict) and path != "name":
                explained = [index for index, line in enumerate(lines) if re.match(rf"\s*{key}:.*#", line)]
                above = [i for i, line in enumerate(lines) if re.match(rf"\s*{key}:", line) and "#" in lines[i - 1]]
                assert explained or above, f"{path} has no comment"

    @pytest.mark.parametrize(
        ("place", "model"),
        [
            ("headset", HeadsetConfig),
            ("control", ControllerSettings),
            ("impedance", ImpedanceSettings),
            ("admittance", AdmittanceSettings),
            ("teleop", TeleopSettings),
            ("mujoco", MujocoConfig),
            ("judge", JudgeSettings),
        ],
    )
    def test_what_is_written_is_the_default(self, place: str, model: type[BaseModel]) -> None:
        written, default = getattr(load_config(CELL), place), model()
        for key in model.model_fields:
            if f"{place}.{key}" not in self.CHOSEN:
                assert getattr(written, key) == getattr(default, key), f"{place}.{key}"
        for key in ("loop_rate_hz", "controller"):
            assert getattr(load_config(CELL), key) == Config.model_fields[key].default

    def test_the_example_of_a_pair_by_name_is_one_that_the_cell_has(self) -> None:
        (example,) = re.findall(r"pairs: \[\] +# .*such as (\[.*?\}\])", CELL.read_text(encoding="utf-8"))
        config = Config.model_validate(yaml.safe_load(changed("control.pairs", yaml.safe_load(example))))
        kept = kept_distances(Robot.from_config(config), config.control)
        assert "pairs[0]" in kept.keys

    def test_the_example_of_a_camera_is_one(self) -> None:
        (example,) = re.findall(r"# (\{front: \{.*\}\}):", CELL.read_text(encoding="utf-8"))
        config = Config.model_validate(yaml.safe_load(changed("cameras", yaml.safe_load(example))))
        assert config.cameras["front"].model_fields_set == CameraConfig.model_fields.keys() - {"link", "rpy", "topic"}

    def test_the_example_of_a_real_camera_is_one_and_not_of_the_simulated_cell(self) -> None:
        (example,) = re.findall(r"# (\{front: \{topic.*\}\})\n", CELL.read_text(encoding="utf-8"))
        config = Config.model_validate(yaml.safe_load(changed("cameras", yaml.safe_load(example))))
        assert config.cameras["front"].topic == "/front/image_raw/compressed"
        assert config.simulated_cameras == {}
