"""An input and a plant of another package: found by their names, and driven like our own."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from q2r2_control.errors import ConfigError
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.types import DeviceControls
from tests.support.processes import cell

PACKAGE = """
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.plants.kinematic import KinematicPlant
from q2r2_control.types import DeviceControls


class Pedal(ScriptedInput):
    controls = DeviceControls(buttons=("button_lower",), axes=())

    @classmethod
    def from_config(cls, config):
        return cls("circle")


class Sluggish(KinematicPlant):
    @classmethod
    def from_config(cls, robot, config):
        return cls(robot, config)
"""
ENTRY_POINTS = """
[q2r2_control.inputs]
pedal = outsider:Pedal
broken = outsider:Nothing

[q2r2_control.plants]
sluggish = outsider:Sluggish
"""


@pytest.fixture
def outsider(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "outsider.py").write_text(PACKAGE)
    metadata = tmp_path / "outsider-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: outsider\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(ENTRY_POINTS)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "outsider", raising=False)


def lower_and(**bindings: str) -> dict[str, object]:
    config = cell()
    changed = type(config.teleop.bindings)(**{"upper": "none", **bindings})
    teleop = config.teleop.model_copy(update={"bindings": changed})
    return {"teleop": teleop, "input": "pedal", "plant": "sluggish"}


@pytest.mark.usefixtures("outsider")
def test_a_cell_names_an_input_and_a_plant_of_another_package_and_both_arms_follow() -> None:
    loop = Pipeline.from_config(cell().model_copy(update=lower_and()))
    assert type(loop.plant).__name__ == "Sluggish"
    summary = loop.run(1.5, realtime=False)
    assert all(arm.engaged_s > 0.2 for arm in summary.arms.values())


@pytest.mark.usefixtures("outsider")
def test_a_binding_to_a_control_that_the_device_does_not_declare_is_refused() -> None:
    config = cell().model_copy(update=lower_and(grip="precision"))
    with pytest.raises(ConfigError, match=r"grip = precision.*no press_middle; allowed: lower"):
        Pipeline.from_config(config)


@pytest.mark.usefixtures("outsider")
def test_an_unknown_name_is_one_line_that_lists_what_is_installed() -> None:
    with pytest.raises(ConfigError, match=r"input 'joystick': allowed are broken, headset, pedal, scripted"):
        Pipeline.from_config(cell(), input="joystick")
    with pytest.raises(ConfigError, match=r"plant 'gazebo': allowed are kinematic, mujoco, sluggish"):
        Pipeline.from_config(cell(), plant="gazebo")


@pytest.mark.usefixtures("outsider")
def test_an_input_that_cannot_be_imported_is_one_line_too() -> None:
    with pytest.raises(ConfigError, match="broken = outsider:Nothing"):
        Pipeline.from_config(cell(), input="broken")


def test_a_device_without_controls_engages_nothing() -> None:
    with pytest.raises(ConfigError, match="no control at all"):
        cell().teleop.bindings.check_device(DeviceControls((), ()))
