"""The package of docs/extending.md: its input, plants, task, preset and command are installed and run unchanged."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.presets import preset_of
from q2r2_control.config.resources import find_resource
from q2r2_control.config.yaml_text import read_yaml, yaml_of
from q2r2_control.errors import ConfigError
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.types import DeviceControls
from tests.cli.command import CELL, q2r2
from tests.support.external_cell import external
from tests.support.modules import blocks_of, install
from tests.support.processes import cell

PAGE = "docs/extending.md"


def merged(data: Any, changes: Any) -> Any:
    if not (isinstance(data, dict) and isinstance(changes, dict)):
        return changes
    return data | {key: merged(data.get(key), value) for key, value in changes.items()}


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the shipped cell with the YAML of docs/extending.md. Its package and a broken plugin are installed."""
    groups: dict[str, dict[str, str]] = {}
    for block in blocks_of(PAGE, "toml"):
        for group, entries in tomllib.loads(block)["project"]["entry-points"].items():
            groups.setdefault(group, {}).update(entries)
    groups["q2r2_control.inputs"]["broken"] = "my_package:Nothing"
    groups["q2r2_control.presets"]["no_preset"] = "my_package:LaggingPlant"
    lines: list[str] = []
    for group, entries in groups.items():
        lines += [f"[{group}]", *(f"{name} = {at}" for name, at in entries.items())]
    install(tmp_path, "my_package", "\n".join(blocks_of(PAGE, "python")), "\n".join(lines))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "my_package", raising=False)
    data = read_yaml(find_resource(CELL).read_text(encoding="utf-8"))
    for block in blocks_of(PAGE, "yaml"):
        data = merged(data, read_yaml(block))
    return changed(tmp_path / "cell.yaml", data)


def changed(file: Path, data: Any) -> Path:
    file.write_text(yaml_of(merged(read_yaml(file.read_text()) if file.exists() else {}, data)))
    return file


def elbow_at_the_end(config: Config) -> float:
    """Return the angle of the left arm's third joint [rad], after both arms have followed their hands."""
    loop = Pipeline.from_config(config.model_copy(update={"loop_rate_hz": 500.0}))
    angles: list[float] = []
    loop.listeners.append(lambda tick: angles.append(tick.reference.q[2]))
    summary = loop.run(2.0, realtime=False)
    assert (type(loop.input).__name__, type(loop.plant).__name__) == ("SwingWithPedal", "LaggingPlant")
    assert all(arm.engaged_s > 1.5 for arm in summary.arms.values())
    return angles[-1]


@pytest.mark.slow
def test_the_input_the_plant_and_the_task_in_docs_extending_run_in_one_pipeline(file: Path) -> None:
    config = load_config(str(file))
    assert "elbows_out" in config.control.tasks
    without = config.model_copy(update={"control": config.control.model_copy(update={"tasks": {}})})
    assert elbow_at_the_end(config) > elbow_at_the_end(without) + 0.05


def test_a_cell_or_a_node_may_name_the_preset_in_docs_extending(tmp_path: Path, file: Path) -> None:
    data = external()
    data["external"] |= {"preset": "compliant"}
    other = load_config(str(changed(tmp_path / "other.yaml", data))).external
    assert other is not None
    assert (other.terms.rate, other.terms.guard.max_velocity) == (125.0, 0.3)
    assert other.topic("left") == "/bh_robot/left_arm_clik_controller/goal_pose"
    assert preset_of("compliant", "raw") == (other.terms, "raw")
    with pytest.raises(ConfigError, match=r"preset = 'unknown': allowed are builtin, .*, jtc, compliant, no_preset"):
        preset_of("unknown", "raw")
    with pytest.raises(ConfigError, match=r"no_preset is .*; allowed: a Preset of that name"):
        preset_of("no_preset", "raw")


@pytest.mark.slow
def test_the_input_in_docs_extending_engages_in_a_real_time_run_too(file: Path) -> None:
    loop = Pipeline.from_config(load_config(str(file)), plant="kinematic")
    summary = loop.run(1.0)
    assert {event.destination for event in summary.events} >= {"engaged"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            {"input": "joystick"},
            "input 'joystick': allowed are broken, headset, policy, recording, scripted, swing, web, webxr",
        ),
        ({"input": "broken"}, "broken = my_package:Nothing"),
        ({"plant": "gazebo"}, "plant 'gazebo': allowed are fri, kinematic, lagging, mujoco, ros, thermal"),
        (
            {"teleop": {"bindings": {"grip": "carry"}}},
            "grip = carry: this input has no press_middle; allowed: device.pedal",
        ),
        (
            {"teleop": {"bindings": {"device": {"knob": "carry"}}}},
            "device.knob = carry: this input has no knob; allowed:",
        ),
    ],
    ids=["input", "cannot be imported", "plant", "binding", "binding by name"],
)
def test_the_command_check_prints_one_line_about_a_missing_plugin_or_control_and_the_pipeline_raises_an_error(
    file: Path, change: dict[str, Any], told: str
) -> None:
    checked = q2r2("check", str(changed(file, change)))
    assert (checked.exit_code, checked.stderr.count("\n")) == (2, 1)
    assert told in checked.stderr
    with pytest.raises(ConfigError, match=re.escape(told)):
        Pipeline.from_config(load_config(str(file)))


def called(file: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run q2r2 in a process that finds the package beside ``file``."""
    path = os.pathsep.join([str(file.parent), *filter(None, sys.path)])
    command = [sys.executable, "-m", "q2r2_control", *arguments]
    return subprocess.run(command, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": path})


@pytest.mark.slow
def test_the_plant_in_docs_extending_reports_a_fault_that_its_command_finds_in_the_recording(file: Path) -> None:
    """The motion heats the drives within two seconds. They cool down while the arms rest."""
    hot = {"allowed": 60, "heating": 20000.0, "cooling_time": 0.2}
    changes = {"loop_rate_hz": 500, "plant_settings": {"thermal": hot}}
    shipped = read_yaml(find_resource(CELL).read_text(encoding="utf-8"))
    cell = str(changed(file.with_name("hot.yaml"), merged(shipped, changes)))
    folder = file.parent / "recordings"
    run = called(file, "run", cell, "--plant", "thermal", "--fast", "--duration", "3", "--record", str(folder))
    assert re.search(r"the plant reports a fault: the drive of \w+ is hotter than 60 degrees\n", run.stderr), run.stderr
    assert "active: the reference starts at the measured posture" in run.stderr
    listed = called(file, "hot-drives", str(folder)).stdout.splitlines()
    assert {line.split(" s, ")[1].split(":")[0] for line in listed} == {"left arm", "right arm"}
    assert all(re.search(r"the drive of \w+ is hotter than 60 degrees$", line) for line in listed)
    assert "hot-drives" in called(file, "--help").stdout


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"allowed": 400.0}, "plant_settings.thermal: allowed = 400.0: allowed: 200 or less"),
        ({"alowed": 60.0}, "plant_settings.thermal: alowed = 60.0: unknown key; did you mean allowed?"),
    ],
    ids=["value", "key"],
)
def test_a_wrong_setting_of_the_plant_in_docs_extending_is_named_by_check_and_run(
    file: Path, settings: dict[str, float], told: str
) -> None:
    """The command check also checks the blocks of plants that are not the cell's."""
    cell = str(changed(file, {"plant": "lagging", "plant_settings": {"thermal": settings}}))
    for arguments in (("check", cell), ("run", cell, "--plant", "thermal")):
        refused = q2r2(*arguments)
        assert (refused.exit_code, refused.stderr.count("\n")) == (2, 1)
        assert told in refused.stderr


def test_a_device_without_any_control_is_refused() -> None:
    with pytest.raises(ConfigError, match="no control at all"):
        cell().teleop.bindings.check_device(DeviceControls((), ()))
