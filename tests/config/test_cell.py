"""The YAML of a cell: every fault ends in one line that says where it is and what is allowed."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from ipaddress import ip_network
from pathlib import Path
from typing import Any, get_args

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
    SpeedLimitSettings,
    TeleopSettings,
    WorkspaceSettings,
)
from q2r2_control.errors import ConfigError, Q2R2Error
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.robot import Robot
from tests.support.external_cell import external, external_text, robot_text

SHIPPED = Path(__file__).resolve().parents[2] / "config"
CELL = SHIPPED / "dual_iiwa7.yaml"


def shipped() -> dict[str, Any]:
    data: dict[str, Any] = yaml.safe_load(CELL.read_text(encoding="utf-8"))
    return data


def loaded(tmp_path: Path, text: str | bytes) -> Config:
    file = tmp_path / "cell.yaml"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return load_config(file)


def fault(tmp_path: Path, text: str | bytes) -> str:
    """What the one line says after the file's name."""
    with pytest.raises(ConfigError) as caught:
        loaded(tmp_path, text)
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'cell.yaml'}: ")
    assert len(message.splitlines()) == 1
    assert len(message) < 700
    return message.removeprefix(f"{tmp_path / 'cell.yaml'}: ")


def changed(path: str, value: object, cell: Callable[[], dict[str, Any]] = shipped) -> str:
    """A cell as YAML with one value replaced or added; ``path`` is written with dots."""
    data = yaml.safe_load(yaml.safe_dump(cell()))
    *parents, key = path.split(".")
    place = data
    for parent in parents:
        place = place[int(parent)] if isinstance(place, list) else place.setdefault(parent, {})
    place[int(key) if isinstance(place, list) else key] = value
    return yaml.safe_dump(data)


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
        SpeedLimitSettings,
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


@pytest.mark.parametrize(
    "path",
    [
        "armz",
        "arms.left.modell",
        "arms.right.mount.positions",
        "arms.left.tool.frames",
        "arms.left.tool.mount.rpyy",
        "arms.left.gripper.forces",
        "obstacles.table.sizes",
        "headset.ports",
        "control.gain",
        "control.distances.arm_table",
        "impedance.stiffness",
        "impedance.wall.depth",
        "admittance.damping",
        "teleop.scale",
        "teleop.filter.cutoff",
        "teleop.gate.jump",
        "teleop.leash.length",
        "arms.left.swivel.shoulders",
        "mujoco.step",
        "mujoco.objects.blue_block.weight",
    ],
)
def test_an_unknown_key_is_named_with_those_allowed_there(tmp_path: Path, path: str) -> None:
    message = fault(tmp_path, changed(path, 1.5))
    assert message.startswith(f"{path} = 1.5: unknown key; allowed here: ")
    data: Any = shipped()
    for parent in path.split(".")[:-1]:
        data = data.get(parent, {})
    allowed = message.partition("allowed here: ")[2].partition(" (and")[0].split(", ")
    assert set(data) <= set(allowed)
    assert allowed


@pytest.mark.parametrize(
    "path",
    ["external.presets", "external.limits.velocity", "external.arms.left.topic", "external.arms.left.gripper.action"],
)
def test_an_unknown_key_of_an_external_controller_is_named_with_those_allowed_there(tmp_path: Path, path: str) -> None:
    message = fault(tmp_path, changed(path, 1.5, external))
    assert message.startswith(f"{path} = 1.5: unknown key; allowed here: ")
    place: Any = external()
    for parent in path.split(".")[:-1]:
        place = place[parent]
    assert set(place) <= set(message.partition("allowed here: ")[2].split(", "))


@pytest.mark.parametrize(
    ("path", "value", "allowed"),
    [
        ("controller", "kuka", "'builtin' or 'external'"),
        ("external.preset", "kuka", "allowed are kuka_lbr_clik, kuka_lbr_impedance, fzi, mayr, crisp, moveit_servo, "),
        ("external.preset", "builtin", "allowed are kuka_lbr_clik"),
        ("external.preset", "jtc", "it takes joint positions, which the built-in controller has to make"),
        ("external.mode", "direct", "'raw' or 'filtered'"),
        ("external.rate", 20, "preset kuka_lbr_clik needs at least 50 Hz"),
        ("external.rate", 1e6, "less than or equal to 1000"),
        ("external.limits.max_velocity", 500, "less than or equal to 5"),
        ("external.limits.max_acceleration", 0, "greater than 0"),
        ("external.arms.left.ctrl_prefix", "left_ctrl", "begins with /"),
        ("external.arms.left.ctrl_prefix", "/left ctrl", "allowed is a ROS name"),
        ("external.arms.left.ctrl_prefix", "/left_ctrl/", "without / at its end"),
        ("external.arms.left.target_topic", "1st", "allowed is a ROS name"),
        ("external.arms.left.base_frame", "", "at least 1 character"),
        ("external.arms.left.base_frame", None, "valid string"),
        ("external.arms.left.gripper.action_type", "Vacuum", "'Float64MultiArray'"),
        ("external.arms.left.gripper.closed_position", 0.0, "have to differ"),
        ("external.arms.middle", {}, "'left' or 'right'"),
        ("external.arms", {}, "at least 1"),
    ],
    ids=lambda value: value if isinstance(value, str) else f"{value!r:.24}",
)
def test_a_bad_value_of_an_external_controller_is_named_with_what_is_allowed(
    tmp_path: Path, path: str, value: object, allowed: str
) -> None:
    message = fault(tmp_path, changed(path, value, external))
    assert message.startswith((path, path.rpartition(".")[0] + " = "))
    assert allowed in message


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (changed("controller", "external"), "controller = 'external': needs the block external, with preset and arms"),
        (changed("controller", "builtin", external), "external: allowed with controller: external only"),
        (
            changed("external.arms", {"left": external()["external"]["arms"]["left"]}, external),
            "external.arms: without right; needed: left, right",
        ),
        (
            changed("arms", {"left": external()["arms"]["left"]}, external),
            "external.arms.right: the cell has no such arm; allowed: left",
        ),
        (
            changed("external.arms.right.ctrl_prefix", "/bh_robot/left_arm_clik_controller", external),
            "external.arms: both have commands /bh_robot/left_arm_clik_controller/target_frame; "
            "allowed: one of its own for each arm",
        ),
        (
            changed("external.arms.right.tool_frame", "left_arm_link_ee", external),
            "external.arms: both have tool_frame left_arm_link_ee; allowed: one of its own for each arm",
        ),
    ],
    ids=[
        "no block",
        "a block too many",
        "an arm missing",
        "an arm too many",
        "one topic for both",
        "one tool for both",
    ],
)
def test_who_drives_the_arms_has_to_be_clear(tmp_path: Path, text: str, says: str) -> None:
    assert fault(tmp_path, text) == says


def test_limits_of_targets_are_for_presets_that_take_targets(tmp_path: Path) -> None:
    cell = external()
    cell["external"] |= {"preset": "jtc", "mode": "filtered"}
    assert loaded(tmp_path, yaml.safe_dump(cell)).external is not None
    cell["external"]["limits"]["max_velocity"] = 0.2
    assert "preset jtc gets joint positions within the limits of the block control" in fault(
        tmp_path, yaml.safe_dump(cell)
    )


def test_a_misspelt_key_is_named_before_the_one_that_is_missing_for_it(tmp_path: Path) -> None:
    message = fault(tmp_path, CELL.read_text().replace("shape: box", "shapes: box"))
    assert message.startswith("obstacles.table.shapes = 'box': unknown key; allowed here: colour, ")


@pytest.mark.parametrize(
    ("path", "value", "allowed"),
    [
        # degrees, millimetres, milliseconds, percent
        ("arms.left.mount.rpy", [0, 0, 90], "less than or equal to 6.28"),
        ("arms.left.mount.position", [0, 400, 0], "less than or equal to 20"),
        ("obstacles.table.size", [800, 1600, 40], "less than or equal to 20"),
        ("obstacles.table.size", [0.8, 1.6, 0], "greater than 0"),
        ("obstacles.table.size", [0.8, 1.6], "a box takes 3 size value(s)"),
        ("obstacles.table.shape", "cube", "'box', 'cylinder', 'sphere' or 'capsule'"),
        ("obstacles.table.colour", [255, 0, 0, 1], "less than or equal to 1"),
        ("teleop.gate.timeout", 150, "less than or equal to 2"),
        ("teleop.position_scale", 0, "greater than 0"),
        ("teleop.stance", "behind", "'side_by_side', 'mirror' or 'mirror_reflected'"),
        ("teleop.axes", ["+x", "+x", "+z"], "once each"),
        ("control.acceleration_limit", 0, "greater than 0"),
        ("control.acceleration_limit", -10, "greater than 0"),
        ("arms.left.flange", "media_flange_touch_pneumatic", "object"),
        ("arms.left.flange", {"thickness": 0.03}, "give both"),
        ("arms.left.flange.thickness", 26, "less than or equal to 0.5"),
        ("arms.left.flange", {"model": "disc", "thickness": 0.03, "radius": 0.05}, "give the model or those"),
        ("arms.left.flange", {"mass": 0.3}, "give its thickness and radius as well"),
        ("arms.left.flange", {"frame": "end"}, "are those of a model: give it as well"),
        ("arms.left.acceleration_limit", 5.0, "allowed: limits by joint, such as {A2: 5.4}"),
        ("arms.left.acceleration_limit", {"A1": -8}, "greater than 0"),
        ("arms.left.acceleration_limit", {"A1": 500}, "less than or equal to 100"),
        ("arms.left.acceleration_limit", {"A1": math.nan}, "finite number"),
        ("arms.left.acceleration_limit", [8.65, 5.44], "allowed: limits by joint, such as {A2: 5.4}"),
        ("control.velocity_scale", 100, "less than or equal to 1"),
        ("control.min_distance", 20, "less than or equal to 0.2"),
        ("control.distances.arm_arm", -0.01, "greater than or equal to 0"),
        ("control.distances.finger_obstacle", 1, "less than or equal to 0.2"),
        ("control.distances.object_obstacle", -20, "greater than or equal to -0.05"),
        ("arms.left.gripper.object", True, "object"),
        ("arms.left.gripper.object", {"box": [0.04, 0.04]}, "missing"),
        ("arms.left.gripper.object", {"box": [40, 40, 60]}, "less than or equal to 1"),
        ("arms.left.gripper.object", {"box": [0.04, 0.04, 0.06], "sphere": 0.03}, "two shapes: give one"),
        ("arms.left.gripper.object", {"sphere": 0}, "greater than 0"),
        ("arms.left.gripper.object", {"mass": -1}, "greater than or equal to 0"),
        ("control.pairs", [{"pair": ["a", "b"], "distance": 5}], "less than or equal to 0.2"),
        ("control.pairs", [{"pair": ["a"], "distance": 0.01}], "missing"),
        ("control.pairs", [{"pair": ["a", ""], "distance": 0.01}], "at least 1 character"),
        ("impedance.translational_stiffness", -1, "greater than 0"),
        ("impedance.rotational_stiffness", 0, "greater than 0"),
        ("impedance.damping_ratio", 0, "greater than or equal to 0.1"),
        ("impedance.nullspace_projector", "none", "'consistent' or 'kinematic'"),
        ("impedance.torque_rate_limit", math.inf, "finite number"),
        ("impedance.wall.stiffness", 0, "greater than 0"),
        ("impedance.wall.maximum_force", -400, "greater than 0"),
        ("admittance.enabled", 1, "valid boolean"),
        ("admittance.mass", 0, "greater than or equal to 0.5"),
        ("cameras.front", {"position": [1, 0, 1]}, "allowed: either look_at or rpy"),
        ("cameras.front", {"width": 640}, "allowed: position, or topic of a real camera"),
        ("cameras.front", {"topic": "/front", "position": [1, 0, 1]}, "position: allowed: without topic"),
        ("cameras.front", {"topic": "front image"}, "should match pattern"),
        ("cameras.front", {"position": [1, 0, 1], "look_at": [1, 0, 1]}, "allowed: another point"),
        ("cameras.front", {"position": [1, 0, 1], "rpy": [0, 0, 0], "width": 641}, "a multiple of 2"),
        ("cameras", {"front/left": {"position": [1, 0, 1], "rpy": [0, 0, 0]}}, "should match pattern"),
        ("mujoco.timestep", 0.01, "less than or equal to 0.001"),
        ("mujoco.rotor_share", 0.0, "greater than or equal to 0.01"),
        ("loop_rate_hz", 1, "greater than or equal to 50"),
        ("loop_rate_hz", 1e300, "less than or equal to 2000"),
        ("loop_rate_hz", 10**400, "finite number"),
        ("headset.port", 70000, "less than or equal to 65535"),
        ("headset.port", 10.5, "valid integer"),
        ("headset.allow", ["192.168.1.7/24"], "write 192.168.1.0/24, or 192.168.1.7 alone"),
        ("headset.allow", ["10.0.0.7", "the lab"], "'the lab' is neither an address nor a network such as"),
        ("headset.allow", [10], "valid string"),
        ("headset.frozen_time", 0.01, "greater than or equal to 0.1"),
        ("headset.watch_frame", "no", "valid boolean"),
        ("teleop.gate.max_speed", 0.0, "greater than 0"),
        ("headset.allow", [], "at least 1"),
        ("arms.left.gripper.closed_position", 0.025, "have to differ"),
        # not numbers, or not the ones meant
        ("control.acceleration_limit", math.nan, "finite number"),
        ("control.velocity_scale", math.inf, "finite number"),
        ("arms.left.mount.position", [0, math.nan, 0], "finite number"),
        ("arms.left.home", [0, -math.inf, 0, 0, 0, 0, 0], "finite number"),
        ("control.position_margin", False, "valid number"),
        ("control.position_margin", "0.01 rad", "valid number"),
        ("control.position_margin", None, "valid number"),
        ("floor", False, "valid number"),
        ("floor", "ground", "valid number"),
        ("floor", -800, "greater than or equal to -20"),
        ("floor", [0, 0, 1], "valid number"),
        ("control.solver", 3, "valid string"),
        ("control.priority", "middle", "allowed here: equal, left, right"),
        ("teleop.leash.distance", 100, "less than or equal to 2"),
        ("teleop.linked", "perhaps", "valid boolean"),
        ("arms.left.home", 0.0, "valid array"),
        ("arms.left.mount.position", [0, 0], "missing"),
        ("arms.left.mount.position", {"x": 0}, "valid array"),
        ("arms.left", None, "object"),
        ("arms.middle", {"model": "iiwa7", "home": [0] * 7}, "'left' or 'right'"),
        ("arms", {}, "at least 1"),
        ("arms", [], "object"),
        ("name", "", "at least 1 character"),
        ("control", [1, 2], "object"),
    ],
    ids=lambda value: value if isinstance(value, str) else f"{value!r:.24}",
)
def test_a_value_out_of_range_or_of_the_wrong_kind_is_named_with_what_is_allowed(
    tmp_path: Path, path: str, value: object, allowed: str
) -> None:
    message = fault(tmp_path, changed(path, value))
    # What concerns two keys together is told of the mapping that has both.
    assert message.startswith((path, path.rpartition(".")[0] + " = "))
    assert allowed in message


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "expected a mapping of keys such as name, arms"),
        ("# only a comment\n", "expected a mapping"),
        ("- name\n- arms\n", "expected a mapping"),
        ("just text", "expected a mapping"),
        ("name: x\n", "arms: missing"),
        ("name: x\narms:\n\tleft: {}\n", "not YAML: .*line 3"),
        ("name: [x\n", "not YAML: .*line"),
        ("name: x\nname: y\n", "key 'name' is given twice .*line 2"),
        ("name: x\narms:\n  left: {model: a, model: b}\n", "key 'model' is given twice .*line 3"),
        ("name: x\narms: *nowhere\n", "undefined alias 'nowhere'"),
        ("name: x\n---\nname: y\n", "a single document"),
        ("name: !!python/object/apply:os.system [ls]\n", "not YAML"),
        ("? [a, b]\n: c\n", "unhashable"),
        ("name: &a [*a]\narms: *a\n", "plain keys and values"),
        ("name: x\nwhen: 2001-99-99\n", "month"),
        ("name: !!int abc\n", "abc"),
        ("name: x\nloop_rate_hz: " + "9" * 5000, "digits"),
        ("[" * 5000, "not YAML"),
        ("{a: " * 5000, "not YAML"),
        ('name: "\\0"\narms: {}\n', "arms"),
        ('"a\\nb": 1\nname: x\narms: {}\n', "a b = 1: unknown key"),
        ("? " + "k" * 9000 + "\n: 1\n", "k = 1: unknown key"),
        (b"name: \xff\xfe\n", "cannot be read: 'utf-8' codec"),
        (b"\x00\x01\x02", "not YAML"),
        (b"name: x\x00\n", "not YAML"),
    ],
    ids=lambda value: repr(value)[:40],
)
def test_what_is_no_cell_at_all_ends_in_one_line(tmp_path: Path, text: str | bytes, says: str) -> None:
    assert re.search(says, fault(tmp_path, text))


@pytest.mark.parametrize(
    ("path", "value", "says"),
    [
        ("arms.left.model", "iiwa8", "arms.left.model = 'iiwa8': .*robots/iiwa14.urdf, robots/iiwa7.urdf"),
        ("arms.left.model", "example-robot-data:nobody", "no such robot; allowed: .*panda"),
        ("arms.left.tool.model", "hand_f", "arms.left.tool.model = 'hand_f'"),
        ("arms.left.tool.link", "elbow", "no such link; allowed: link_0"),
        ("arms.left.tool.frame", "tip", "no such link; allowed: .*tool_frame"),
        ("arms.left.gripper.joints", ["thumb"], "no such finger joint; allowed: finger_joint_1"),
        ("arms.left.home", [90, 0, 0, 0, 0, 0, 0], r"arms.left.home\[0\] = 90: joint A1 allows -2.96"),
        ("arms.left.home", [0, 0], "2 value.s., expected 7: A1"),
        ("arms.left.acceleration_limit", {"A9": 5.0}, r"arms.left.acceleration_limit.A9: no joint .* allowed: A1, A2"),
    ],
)
def test_what_only_the_robot_can_tell_is_named_when_it_is_composed(
    tmp_path: Path, path: str, value: object, says: str
) -> None:
    config = loaded(tmp_path, changed(path, value))
    with pytest.raises(Q2R2Error, match=says) as caught:
        Robot.from_config(config)
    assert len(str(caught.value).splitlines()) == 1


def test_the_number_of_further_faults_is_told(tmp_path: Path) -> None:
    text = changed("control", {"acceleration_limit": -1, "min_distance": -1, "solver": 5})
    assert fault(tmp_path, text).endswith("(and 2 more)")


def test_one_arm_alone_is_allowed(tmp_path: Path) -> None:
    text = changed("arms", {"left": shipped()["arms"]["left"]})
    assert list(loaded(tmp_path, text).arms) == ["left"]


def test_numbers_may_be_written_in_every_usual_way(tmp_path: Path) -> None:
    values = {"1e-3": 1e-3, "1.0e-3": 1e-3, "2E-2": 2e-2, "5e-1": 0.5, "0": 0.0, ".25": 0.25}
    for text, value in values.items():
        minimal = "name: x\narms: {left: {model: iiwa7, home: [0]}}\n"
        assert loaded(tmp_path, f"{minimal}control: {{position_margin: {text}}}\n").control.position_margin == value


def test_a_mapping_may_be_merged_into_another_and_changed_there(tmp_path: Path) -> None:
    text = (
        "name: x\narms:\n  left: &arm\n    model: iiwa7\n    home: [0]\n"
        "  right:\n    <<: *arm\n    mount: {position: [0, -1, 0]}\n    home: [1]\n"
    )
    arms = loaded(tmp_path, text).arms
    assert (arms["right"].model, arms["right"].home, arms["left"].home) == ("iiwa7", (1.0,), (0.0,))


class TestRelativePathsAreLookedUp:
    """From the file's folder, then from the working directory, then among what ships."""

    URDF = (
        '<robot name="{name}"><link name="base"/><link name="rod"/><joint name="hinge" type="revolute">'
        '<parent link="base"/><child link="rod"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>'
    )

    @pytest.fixture
    def folders(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
        """The folder of a YAML file and the working directory, each with everything."""
        for name in ("cell", "work"):
            folder = tmp_path / name
            (folder / "robots").mkdir(parents=True)
            for file in ("rod.urdf", "robots/rod.urdf"):
                (folder / file).write_text(self.URDF.format(name=name))
            (folder / "pairs.srdf").write_text(f'<robot name="{name}"/>')
        monkeypatch.chdir(tmp_path / "work")
        return tmp_path / "cell", tmp_path / "work"

    def config(self, folder: Path, model: str) -> Config:
        (folder / "cell.yaml").write_text(
            f"name: x\nsrdf: pairs.srdf\narms: {{left: {{model: {model}, home: [0]}}}}\n", encoding="utf-8"
        )
        return load_config(folder / "cell.yaml")

    @pytest.mark.parametrize("model", ["rod.urdf", "rod", "../cell/rod.urdf"])
    def test_from_the_folder_of_the_file_first(self, folders: tuple[Path, Path], model: str) -> None:
        cell, _ = folders
        config = self.config(cell, model)
        assert config.srdf == str(cell / "pairs.srdf")
        assert Path(config.model_of("left")).resolve().is_relative_to(cell)
        assert Robot.from_config(config).joint_names == ("left_hinge",)

    @pytest.mark.parametrize("model", ["rod.urdf", "rod"])
    def test_then_from_the_working_directory(self, folders: tuple[Path, Path], model: str) -> None:
        cell, _ = folders
        for file in ("rod.urdf", "robots/rod.urdf", "pairs.srdf"):
            (cell / file).unlink()
        config = self.config(cell, model)
        assert (config.model_of("left"), config.srdf) == (model, "pairs.srdf")
        assert Robot.from_config(config).joint_names == ("left_hinge",)

    def test_then_among_what_ships(self, folders: tuple[Path, Path]) -> None:
        cell, work = folders
        for folder in (cell, work):
            (folder / "pairs.srdf").unlink()
        (cell / "cell.yaml").write_text("name: x\narms: {left: {model: iiwa7, home: [0, 0, 0, 0, 0, 0, 0]}}\n")
        assert Robot.from_config(load_config(cell / "cell.yaml")).model.nv == 7

    def test_of_a_robot_that_arms_share_and_of_tools_too(self, folders: tuple[Path, Path]) -> None:
        cell, _ = folders
        (cell / "cell.yaml").write_text(
            "name: x\nrobot: {model: rod.urdf}\narms: {left: {home: [0], tool: {model: robots/rod.urdf}}}\n"
            "packages: {mine: robots}\n"
        )
        config = load_config(cell / "cell.yaml")
        assert config.model_of("left") == str(cell / "rod.urdf")
        assert config.arms["left"].tool.model == str(cell / "robots" / "rod.urdf")
        assert config.packages == {"mine": str(cell / "robots")}

    @pytest.mark.parametrize("path", ["x" * 5000 + ".urdf", "a\x00.urdf", ""])
    def test_and_what_no_file_can_be_called_ends_in_one_line(self, tmp_path: Path, path: str) -> None:
        config = loaded(tmp_path, changed("arms.left.model", path))
        with pytest.raises(Q2R2Error) as caught:
            Robot.from_config(config)
        assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("path", "value", "frame"),
    [
        ("arms.left.tool.frame", "tool_frame", "left_tool_frame"),
        ("arms.left.tool.frame", None, None),
        ("arms.left.tool", {"frame": "link_7"}, "left_link_7"),
        ("arms.left.tool", {"link": "link_7"}, "left_link_7"),
        ("arms.left.tool", {}, None),
    ],
)
def test_the_tool_frame_is_called_by_side_where_the_file_names_it(
    tmp_path: Path, path: str, value: object, frame: str | None
) -> None:
    config = loaded(tmp_path, changed(path, value))
    assert config.named_tool_frame("left") == frame


def test_the_tool_frame_of_a_shared_robot_keeps_its_name(tmp_path: Path) -> None:
    text = "name: x\nrobot: {model: iiwa7}\narms: {left: {tip: link_7, home: [0]}}\n"
    assert loaded(tmp_path, text).named_tool_frame("left") == "link_7"


@pytest.mark.parametrize(
    ("key", "tool"), [("tool.link", {"model": "hand_e", "link": "link_7"}), ("tool.frame", {"frame": "link_7"})]
)
def test_two_different_links_for_the_end_of_one_arm_are_refused(tmp_path: Path, key: str, tool: dict[str, str]) -> None:
    arm = {"model": "iiwa7", "home": [0] * 7, "tip": "link_ee", "tool": tool}
    message = fault(tmp_path, changed("arms.left", arm))
    assert f"tip = 'link_ee' and {key} = 'link_7' mean the same link: give one" in message


def test_networks_that_may_connect_are_read_as_such(tmp_path: Path) -> None:
    headset = loaded(tmp_path, changed("headset.allow", ["192.168.1.0/24", "10.0.0.7", "fd00::/64"])).headset
    assert headset.networks == tuple(map(ip_network, ("192.168.1.0/24", "10.0.0.7/32", "fd00::/64")))
    assert loaded(tmp_path, changed("headset.allow", None)).headset.networks is None
