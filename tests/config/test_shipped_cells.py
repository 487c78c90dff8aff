"""Every shipped cell loads. The file dual_iiwa7.yaml shows all settings with comments."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import BaseModel

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.yaml_text import read_yaml
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.robot import Robot
from tests.config.cell_files import CELL, SHIPPED, changed
from tests.support.external_cell import external_text, robot_text


@pytest.mark.parametrize("file", sorted(SHIPPED.glob("*.yaml")), ids=lambda file: file.stem)
def test_every_shipped_cell_loads_and_has_the_name_of_its_file(file: Path) -> None:
    assert load_config(file).name == file.stem


def models_in(annotation: object) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from models_in(inner)


def shown(model: type[BaseModel], data: dict[str, Any], place: str = "") -> Iterator[tuple[str, type[BaseModel], Any]]:
    """Yield the path, the model and the data of every block of a file.

    If the user chooses the names of blocks, as for obstacles, only the first of these blocks is yielded.
    """
    yield place, model, data
    for key, field in model.model_fields.items():
        value, path = data.get(key), f"{place}.{key}".lstrip(".")
        for inner in models_in(field.annotation):
            if isinstance(value, dict) and value and not set(value) <= set(inner.model_fields):
                name, value = next(iter(value.items()))
                path = f"{path}.{name}"
            if isinstance(value, dict) and value:
                yield from shown(inner, value, path)


class TestTheShippedCellShowsAllThereIsToTune:
    # Keys whose value differs from the default. A comment in the file says so.
    CHOSEN = ("control.solve_time_limit", "control.distances", "mujoco.objects")
    # Keys that may be missing here, because another block of the same kind or the other text of the test shows them.
    SHOWN_ELSEWHERE = ("arms.left.tool.mount", "obstacles.table.rpy", "robot.mount.rpy", "external")

    @pytest.mark.parametrize("text", [external_text(), robot_text()], ids=["arms of their own", "one robot"])
    def test_every_setting_is_written_in_the_cells_file_and_has_a_comment(self, text: str) -> None:
        lines = text.splitlines()
        for place, model, data in shown(Config, read_yaml(text)):
            if place == "arms.left" and "robot:" in text:
                # Here the block "robot" describes both arms, so the block "arms.left" lacks some keys.
                continue
            for key in model.model_fields:
                path = f"{place}.{key}".lstrip(".")
                if path in self.SHOWN_ELSEWHERE:
                    continue
                assert key in data, path
                if not isinstance(data[key], dict) and path != "name":
                    at = [index for index, line in enumerate(lines) if re.match(rf"\s*{key}:", line)]
                    assert any("#" in lines[index] or "#" in lines[index - 1] for index in at), f"{path} has no comment"

    @pytest.mark.parametrize(
        "place", ["headset", "control", "impedance", "admittance", "supervision", "teleop", "mujoco", "judge"]
    )
    def test_the_values_in_the_shipped_cells_file_are_the_defaults(self, place: str) -> None:
        written = getattr(load_config(CELL), place)
        default = type(written)()
        for key in type(written).model_fields:
            if f"{place}.{key}" not in self.CHOSEN:
                assert getattr(written, key) == getattr(default, key), f"{place}.{key}"
        for key in ("loop_rate_hz", "controller"):
            assert getattr(load_config(CELL), key) == Config.model_fields[key].default

    def test_the_pair_in_the_example_for_control_pairs_exists_in_the_cell(self) -> None:
        (example,) = re.findall(r"names of the bodies, such as (\[.*?\}\])", CELL.read_text(encoding="utf-8"))
        config = Config.model_validate(read_yaml(changed("control.pairs", read_yaml(example))))
        kept = kept_distances(Robot.from_config(config), config.control)
        assert "pairs[0]" in kept.keys

    def test_the_example_of_a_real_camera_is_valid_and_the_cell_has_three_simulated_cameras(self) -> None:
        (example,) = re.findall(r"# (\{front: \{topic.*\}\})\n", CELL.read_text(encoding="utf-8"))
        assert not Config.model_validate(read_yaml(changed("cameras", read_yaml(example)))).simulated_cameras
        assert list(load_config(CELL).simulated_cameras) == ["above", "left_wrist", "right_wrist"]
