"""Files that a cell names are searched in several folders, one after the other."""

from __future__ import annotations

from pathlib import Path

import pytest

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.errors import Q2R2Error
from q2r2_control.robot.robot import Robot
from tests.config.cell_files import changed, loaded


class TestRelativePathsAreLookedUp:
    """Paths are searched from the file's folder, then from the working directory, then among the shipped files."""

    URDF = (
        '<robot name="{name}"><link name="base"/><link name="rod"/><joint name="hinge" type="revolute">'
        '<parent link="base"/><child link="rod"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>'
    )

    @pytest.fixture
    def folders(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
        """Return the folder of a YAML file and the working directory, which both contain all files."""
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
    def test_a_file_is_searched_first_in_the_folder_of_the_yaml_file(
        self, folders: tuple[Path, Path], model: str
    ) -> None:
        cell, _ = folders
        config = self.config(cell, model)
        assert config.srdf == str(cell / "pairs.srdf")
        assert Path(config.model_of("left")).resolve().is_relative_to(cell)
        assert Robot.from_config(config).joint_names == ("left_hinge",)

    @pytest.mark.parametrize("model", ["rod.urdf", "rod"])
    def test_a_file_that_is_not_in_the_folder_of_the_yaml_file_is_searched_in_the_working_directory(
        self, folders: tuple[Path, Path], model: str
    ) -> None:
        cell, _ = folders
        for file in ("rod.urdf", "robots/rod.urdf", "pairs.srdf"):
            (cell / file).unlink()
        config = self.config(cell, model)
        assert (config.model_of("left"), config.srdf) == (model, "pairs.srdf")
        assert Robot.from_config(config).joint_names == ("left_hinge",)

    def test_paths_of_a_shared_robot_and_of_tools_are_searched_too(self, folders: tuple[Path, Path]) -> None:
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
    def test_a_name_that_no_file_can_have_raises_an_error_of_one_line(self, tmp_path: Path, path: str) -> None:
        config = loaded(tmp_path, changed("arms.left.model", path))
        with pytest.raises(Q2R2Error) as caught:
            Robot.from_config(config)
        assert len(str(caught.value).splitlines()) == 1
