"""Every fault in the YAML of a cell raises an error of one line that names the key and what is allowed."""

from __future__ import annotations

import math
import re
from ipaddress import ip_network
from pathlib import Path
from typing import Any

import pytest

from q2r2_control.config.cell_file import parse_config
from q2r2_control.config.fri import ModbusGripperConfig
from q2r2_control.errors import ConfigError
from q2r2_control.plants.fri.answers import CATCH_UP
from tests.config.cell_files import CELL, changed, fault, loaded, shipped
from tests.support.external_cell import external

ARM = {"model": "iiwa7", "home": [0] * 7, "tip": "link_ee"}


@pytest.mark.parametrize(
    "path",
    [
        "armz",
        "arms.right.mount.positions",
        "control.distances.arm_table",
        "teleop.filter.cutoff",
        "mujoco.objects.blue_block.weight",
        *("external.presets", "external.limits.velocity", "external.arms.left.topic"),
        "external.arms.left.gripper.action",
    ],
)
def test_the_error_about_an_unknown_key_lists_the_keys_that_its_block_may_have(tmp_path: Path, path: str) -> None:
    cell = external if path.startswith("external") else shipped
    message = fault(tmp_path, changed(path, 1.5, cell))
    assert message.startswith(f"{path} = 1.5: unknown key; ")
    data: Any = cell()
    for parent in path.split(".")[:-1]:
        data = data.get(parent, {})
    allowed = message.partition("allowed here: ")[2].partition(" (and")[0].split(", ")
    assert set(data) <= set(allowed)
    assert allowed


@pytest.mark.parametrize(
    ("gripper", "allowed"),
    [
        ({"modbus": "gripper", "units": 9}, "counts, force, modbus, speed, unit"),
        ({"units": 9}, "digital, input, output"),
    ],
)
def test_the_error_about_an_unknown_key_of_a_gripper_lists_the_keys_for_grippers_of_its_kind(
    tmp_path: Path, gripper: dict[str, Any], allowed: str
) -> None:
    message = fault(tmp_path, changed("fri.left.gripper", gripper))
    assert message.startswith("fri.left.gripper.units = 9: unknown key; ")
    assert f"allowed here: {allowed}" in message


def test_the_velocity_scale_of_a_fri_cell_keeps_velocity_limits_while_commands_catch_up_after_a_delay(
    tmp_path: Path,
) -> None:
    def scale(given: float) -> float:
        text = changed("control.velocity_scale", given, lambda: shipped() | {"fri": {"left": {}, "right": {}}})
        return loaded(tmp_path, text).control.velocity_scale

    assert (1.0 + CATCH_UP) * scale(1.0) <= 1.0
    assert scale(0.5) == 0.5


def test_the_address_of_a_modbus_gripper_is_a_host_or_a_serial_device(tmp_path: Path) -> None:
    for modbus, endpoint in (("[::1]:1502", ("::1", 1502)), ("gripper", ("gripper", 502)), ("/dev/ttyUSB0", None)):
        config = loaded(tmp_path, changed("fri.left.gripper", {"modbus": modbus}))
        gripper = config.fri["left"].gripper
        assert isinstance(gripper, ModbusGripperConfig)
        assert gripper.endpoint == endpoint


def test_a_misspelt_key_is_named_before_the_key_that_is_therefore_missing(tmp_path: Path) -> None:
    message = fault(tmp_path, CELL.read_text().replace("shape: box", "shapes: box"))
    assert message.startswith("obstacles.table.shapes = 'box': unknown key; did you mean shape? allowed here: colour, ")


@pytest.mark.parametrize(
    ("path", "value", "allowed"),
    [
        # Values in degrees, millimetres, milliseconds or percent are refused.
        ("arms.left.mount.rpy", [0, 0, 90], "6.2832 or less"),
        ("obstacles.table.size", [0.8, 1.6], "a box takes 3 size value(s)"),
        ("teleop.stance", "behind", "'side_by_side', 'mirror' or 'mirror_reflected'"),
        ("teleop.axes", ["+x", "+x", "+z"], "once each"),
        ("arms.left.flange", {"thickness": 0.03}, "give both"),
        ("fri.left.gripper.modbus", "gripper:0", "host:port or host, or a serial device such as /dev/ttyUSB0"),
        ("fri.left.gripper", {"modbus": "gripper", "counts": [230, 3]}, "a count for closed above the one for open"),
        ("arms.left.flange", {"model": "disc", "thickness": 0.03, "radius": 0.05}, "give the model or those"),
        ("arms.left.flange", {"mass": 0.3}, "give its thickness and radius as well"),
        ("arms.left.flange", {"frame": "end"}, "are those of a model: give it as well"),
        (
            "arms.left",
            ARM | {"tool": {"model": "hand_e", "link": "link_7"}},
            "and tool.link = 'link_7' mean the same",
        ),
        (
            "arms.left",
            ARM | {"tool": {"frame": "link_7"}},
            "and tool.frame = 'link_7' mean the same link",
        ),
        ("arms.left.acceleration_limit", 5.0, "allowed: limits by joint, such as {A2: 5.4}"),
        ("arms.left.acceleration_limit", {"A1": -8}, "more than 0"),
        ("arms.left.gripper.object", {"box": [0.04, 0.04, 0.06], "sphere": 0.03}, "two shapes: give one"),
        ("control.pairs", [{"pair": ["a", ""], "distance": 0.01}], "1 or more characters"),
        ("cameras.front", {"position": [1, 0, 1]}, "allowed: either look_at or rpy"),
        ("cameras.front", {"width": 640}, "allowed: position, or topic or device of a real camera"),
        ("cameras.front", {"topic": "/front", "device": 0}, "allowed: either topic or device"),
        ("cameras.front", {"device": 0, "position": [1, 0, 1]}, "position: allowed: without device"),
        ("cameras.front", {"topic": "/front", "delay": 0.1}, "delay: allowed: with device"),
        ("cameras.front", {"device": "front.mp4", "exposure": 0.01}, "exposure: allowed: of a V4L2"),
        ("cameras.front", {"device": 0, "rotation": 45}, "allowed: 0, 90, 180 or 270"),
        ("cameras.front", {"topic": "/front", "position": [1, 0, 1]}, "position: allowed: without topic"),
        ("cameras.front", {"position": [1, 0, 1], "look_at": [1, 0, 1]}, "allowed: another point"),
        ("cameras", {"front/left": {"position": [1, 0, 1], "rpy": [0, 0, 0]}}, "should match pattern"),
        ("cameras.front", {"position": [1, 0, 1], "rpy": [0, 0, 0], "width": 641}, "a multiple of 2"),
        ("loop_rate_hz", 10**400, "finite number"),
        ("headset.allow", ["192.168.1.7/24"], "write 192.168.1.0/24, or 192.168.1.7 alone"),
        ("headset.allow", ["10.0.0.7", "the lab"], "'the lab' is neither an address nor a network such as"),
        ("arms.left.gripper.closed_position", 0.025, "have to differ"),
        # NaN, texts instead of numbers, and names that are not allowed are refused.
        ("control.acceleration_limit", math.nan, "finite number"),
        ("control.position_margin", "0.01 rad", "allowed: a number"),
        ("recording.topic_rate", "fast", "allowed: a number, or null"),
        ("control.priority", "middle", "allowed here: equal, left, right"),
        ("arms.middle", {"model": "iiwa7", "home": [0] * 7}, "'left' or 'right'"),
        # The next faults are in the keys for an external controller.
        ("controller", "kuka", "'builtin' or 'external'"),
        ("external.preset", "kuka", "allowed are kuka_lbr_clik, kuka_lbr_impedance, fzi, mayr, crisp, moveit_servo, "),
        ("external.rate", 20, "preset kuka_lbr_clik needs at least 50 Hz"),
        ("external.arms.left.ctrl_prefix", "left_ctrl", "begins with /"),
        ("external.arms.left.ctrl_prefix", "/left ctrl", "allowed is a ROS name"),
        ("external.arms.left.ctrl_prefix", "/left_ctrl/", "without / at its end"),
        ("external.arms.left.base_frame", "", "1 or more characters"),
        ("external.arms.left.gripper.closed_position", 0.0, "have to differ"),
    ],
    ids=lambda value: value if isinstance(value, str) else f"{value!r:.24}",
)
def test_the_error_about_a_wrong_value_names_its_key_and_says_what_is_allowed(
    tmp_path: Path, path: str, value: object, allowed: str
) -> None:
    message = fault(tmp_path, changed(path, value, external if path.startswith("external") else shipped))
    # A fault that concerns two keys is reported at the mapping that contains both keys.
    assert message.startswith((path, path.rpartition(".")[0] + ": "))
    assert allowed in message


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "the file is empty; allowed: a cell's YAML"),
        ("# nothing\n", "the file is empty"),
        ("- name\n- arms\n", "expected a mapping"),
        ("name: x\n", "arms: missing"),
        ("name: x\narms:\n\tleft: {}\n", "not YAML: .* in line 3, column 1$"),
        ("name: x\nname: y\n", "key 'name' is given twice .*line 2"),
        ("name: x\narms:\n  left: {model: a, model: b}\n", "key 'model' is given twice .*line 3"),
        ("name: x\narms: *nowhere\n", "undefined alias.*line 2, column 7"),
        ("name: !!python/object/apply:os.system [ls]\n", "not YAML"),
        ("name: &a [*a]\narms: *a\n", "plain keys and values"),
        ("name: x\nwhen: 2001-99-99\n", "month"),
        ("name: x\nloop_rate_hz: " + "9" * 5000, "digits"),
        ("[" * 5000, "not YAML"),
        ('"a\\nb": 1\nname: x\narms: {}\n', "a b = 1: unknown key"),
        ("? " + "k" * 9000 + "\n: 1\n", "k = 1: unknown key"),
        (b"name: \xff\xfe\n", "is not a text file in UTF-8; allowed: a cell's YAML"),
    ],
    ids=lambda value: repr(value)[:40],
)
def test_a_file_that_is_not_a_cell_raises_an_error_of_one_line(tmp_path: Path, text: str | bytes, says: str) -> None:
    assert re.search(says, fault(tmp_path, text))


def test_each_fault_in_a_file_is_named_with_its_line(tmp_path: Path) -> None:
    text = (
        "name: x\n"
        "arms:\n"
        "  left: &arm\n"
        "    model: iiwa7\n"
        "    home:\n"
        "      - 0\n"
        "      - up\n"
        "  right:\n"
        "    <<: *arm\n"
        "    home: [0]\n"
        "    tool: {}\n"
        "    gripper: {width: wide}\n"
        "obstacles:\n"
        "  table:\n"
        "    pose: {}\n"
        "colour: {red: 1}\n"
    )
    with pytest.raises(ConfigError) as caught:
        loaded(tmp_path, text)
    said = [re.fullmatch(r".*cell.yaml, line (\d+): ([\w.]+).*", line) for line in caught.value.faults]
    assert [(int(one[1]), one[2]) for one in said if one is not None] == [
        (12, "arms.right.gripper.width"),
        (15, "obstacles.table.pose"),
        (16, "colour"),
        (7, "arms.left.home.1"),
        (14, "obstacles.table.shape"),  # The key is missing, so the error names the line of its block.
        (14, "obstacles.table.size"),
    ]
    with pytest.raises(ConfigError) as of_no_file:
        parse_config(text, "its cell")
    assert not any(", line " in fault for fault in of_no_file.value.faults)


def test_the_message_contains_the_number_of_further_faults(tmp_path: Path) -> None:
    text = changed("control", {"acceleration_limit": -1, "min_distance": -1, "max_substep": -1})
    assert fault(tmp_path, text).endswith("(and 2 more)")


def test_numbers_may_be_written_in_every_usual_notation(tmp_path: Path) -> None:
    values = {"1e-3": 1e-3, "1.0e-3": 1e-3, "2E-2": 2e-2, "5e-1": 0.5, "0": 0.0, ".25": 0.25}
    for text, value in values.items():
        minimal = "name: x\narms: {left: {model: iiwa7, home: [0]}}\n"
        assert loaded(tmp_path, f"{minimal}control: {{position_margin: {text}}}\n").control.position_margin == value


def test_a_mapping_can_be_merged_into_another_mapping_which_replaces_some_of_its_values(tmp_path: Path) -> None:
    text = (
        "name: x\narms:\n  left: &arm\n    model: iiwa7\n    home: [0]\n"
        "  right:\n    <<: *arm\n    mount: {position: [0, -1, 0]}\n    home: [1]\n"
    )
    arms = loaded(tmp_path, text).arms
    assert (arms["right"].model, arms["right"].home, arms["left"].home) == ("iiwa7", (1.0,), (0.0,))


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
def test_the_name_of_a_tool_frame_in_the_file_gets_the_prefix_of_its_side(
    tmp_path: Path, path: str, value: object, frame: str | None
) -> None:
    config = loaded(tmp_path, changed(path, value))
    assert config.named_tool_frame("left") == frame


def test_addresses_and_networks_from_which_headsets_may_connect_are_read_as_ip_networks(tmp_path: Path) -> None:
    headset = loaded(tmp_path, changed("headset.allow", ["192.168.1.0/24", "10.0.0.7", "fd00::/64"])).headset
    assert headset.networks == tuple(map(ip_network, ("192.168.1.0/24", "10.0.0.7/32", "fd00::/64")))
    assert loaded(tmp_path, changed("headset.allow", None)).headset.networks is None
