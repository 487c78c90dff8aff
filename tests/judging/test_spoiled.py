"""A clean episode with cameras is kept. Each copy with one added fault is discarded for this fault."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from q2r2_control.config.recording import CameraConfig, JudgeSettings
from q2r2_control.judging.camera_figures import arm_of_link
from q2r2_control.judging.judge import judge
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.recording.reader import Recording
from q2r2_control.robot.robot import Robot
from tests.judging.episodes import hands, loop_of, record_episode
from tests.judging.spoilers import CAMERAS, NUMBERS, Contents, Spoiler, empty, retitled, spoiled
from tests.recording.runs import file_of, pipeline, record
from tests.support.pictures import needs_opengl
from tests.support.processes import cell

pytestmark = pytest.mark.slow

DURATION = 4.0  # [s]
SMALL = {"width": 96, "height": 72}


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an episode without pictures, so that the test needs no OpenGL."""
    return record_episode(tmp_path_factory.mktemp("clean"), hands(), DURATION)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an episode with small pictures of the shipped cell's three cameras."""
    needs_opengl()
    cameras = {name: camera.model_copy(update=SMALL) for name, camera in cell().cameras.items()}
    config = loop_of(hands()).config.model_copy(update={"cameras": cameras})
    loop = Pipeline.from_config(config, input=hands(), plant="mujoco")
    return file_of(record(tmp_path_factory.mktemp("filmed"), loop, DURATION))


def reasons(file: Path, settings: JudgeSettings | None = None) -> set[str]:
    (found,) = judge(Recording(file), settings)
    return {reason.name for reason in found.verdict.reasons}


def test_an_unspoiled_episode_is_kept(clean: Path, tmp_path: Path) -> None:
    assert reasons(spoiled(clean, tmp_path / "same.mcap")) == set()


def test_an_unspoiled_episode_with_pictures_is_kept_and_its_pictures_come_on_time(filmed: Path) -> None:
    (found,) = judge(Recording(filmed))
    assert found.verdict.line == "keep"
    assert {name: camera.arm for name, camera in found.figures.cameras.items()} == {
        "above": None,
        "left_wrist": "left",
        "right_wrist": "right",
    }
    for camera in found.figures.cameras.values():
        assert camera.lag_ms == pytest.approx(0.0, abs=60.0)
        assert camera.rate_share == pytest.approx(1.0, abs=0.03)
        assert camera.frozen_share == camera.black_share == camera.bad_pictures == 0


def test_an_episode_of_a_smooth_circle_with_a_small_camera_is_kept(tmp_path: Path) -> None:
    """The tools' speed hardly changes, so pictures fit many lags almost equally well. The judge finds no large lag."""
    needs_opengl()
    front = CameraConfig(position=(1.9, 0.0, 1.0), look_at=(0.4, 0.0, 0.3), width=64, height=48, rate=30.0)
    loop = pipeline("circle", "mujoco", cameras={"front": front})
    (found,) = judge(Recording(file_of(record(tmp_path, loop, 10.0))))
    assert found.verdict.line == "keep"


@pytest.mark.parametrize("what", NUMBERS)
def test_an_episode_with_a_fault_in_its_numbers_is_discarded_for_this_fault(
    what: str, clean: Path, tmp_path: Path
) -> None:
    spoil, reason = NUMBERS[what]
    assert reason in reasons(spoiled(clean, tmp_path / "spoiled.mcap", spoil))


@pytest.mark.parametrize("what", CAMERAS)
def test_an_episode_with_a_fault_in_its_pictures_is_discarded_for_this_fault(
    what: str, filmed: Path, tmp_path: Path
) -> None:
    spoil, reason = CAMERAS[what]
    assert reason in reasons(spoiled(filmed, tmp_path / "spoiled.mcap", spoil))


def not_felt(contents: Contents) -> None:
    contents.rows["tau"] = float("nan")
    contents.rows["arms"]["opening"] = -float("inf")


def one_picture_is_lost(contents: Contents) -> None:
    contents.keep_pictures("above", lambda number: number != 20)


def without_task(contents: Contents) -> None:
    contents.about = replace(contents.about, notes={})


HARMLESS: dict[str, Spoiler] = {
    "torques and openings that nothing measures": not_felt,
    "no measured velocity": lambda contents: contents.rows["v"].fill(0.0),
    "no task": without_task,
    "a task that says to grasp, and a gripper that moves": lambda contents: retitled(contents, "pick the block"),
}


@pytest.mark.parametrize("what", HARMLESS)
def test_an_episode_without_optional_data_is_kept(what: str, clean: Path, tmp_path: Path) -> None:
    assert reasons(spoiled(clean, tmp_path / "harmless.mcap", HARMLESS[what])) == set()


def test_one_lost_picture_is_no_reason_to_discard_an_episode(filmed: Path, tmp_path: Path) -> None:
    assert reasons(spoiled(filmed, tmp_path / "lost.mcap", one_picture_is_lost)) == set()


def test_an_episode_without_a_task_is_discarded_if_the_cell_requires_a_task(clean: Path, tmp_path: Path) -> None:
    file = spoiled(clean, tmp_path / "untold.mcap", without_task)
    assert reasons(file, JudgeSettings(needs_task=True)) == {"needs_task"}


def test_a_topic_that_only_some_runs_have_may_be_empty(clean: Path, tmp_path: Path) -> None:
    assert reasons(spoiled(clean, tmp_path / "quiet.mcap", empty("/q2r2/external_torque"))) == set()


def test_a_link_belongs_to_the_arm_whose_joints_move_it() -> None:
    robot = Robot.from_config(cell())
    assert [arm_of_link(robot, link) for link in ("left_hand_e_base", "world", "nowhere")] == ["left", None, None]
