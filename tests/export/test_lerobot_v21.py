"""A LeRobotDataset v2.1 has every number, picture and task where openpi and GR00T look for them.

In tests/lerobot, LeRobot itself reads such a dataset.
"""

from __future__ import annotations

import ast
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from q2r2_control.config.recording import CameraConfig
from q2r2_control.export import lerobot_v21
from q2r2_control.export.dataset_card import CARD, write_card
from q2r2_control.export.lerobot_v21 import DESCRIPTION, SUBTASK_DESCRIPTION, openpi_config, openpi_names
from q2r2_control.extras import install_line
from tests.cli.command import q2r2
from tests.export.files import EPISODES, HEIGHT, TOLD, WIDTH, Waves
from tests.export.test_formats import export
from tests.support.modules import load_script

pa = pytest.importorskip("pyarrow", reason="the extra export is not installed")
parquet = pytest.importorskip("pyarrow.parquet", reason="the extra export is not installed")
av = pytest.importorskip("av", reason="the extra export is not installed")

JOINTS = ("left_A1", "left_A2", "right_A1", "right_A2")
POSITIONS = (*JOINTS, "left_gripper", "right_gripper")
NAMES = {"observation.state": POSITIONS, "action": POSITIONS, "intervention": ("left", "right")}
LEFT_LINK = CameraConfig(position=(1, 0, 1), rpy=(0, 0, 0), link="left_hand_e_base")
SEEN = [
    replace(
        plain,
        names=NAMES,
        vectors={
            name: np.random.default_rng(seed).normal(size=(plain.frames, len(labels))).astype(np.float32)
            for name, labels in NAMES.items()
        },
        cameras={"front": Waves(plain.frames, seed), "hand": Waves(plain.frames, seed + 9, config=LEFT_LINK)},  # type: ignore[dict-item]
    )
    for seed, plain in enumerate(EPISODES)
]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export("lerobot-v2.1", SEEN, tmp_path_factory.mktemp("v21"), ["1", "2", "3"])


def lines(file: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in file.read_text().splitlines()]


def test_every_episode_has_a_table_of_its_numbers_and_tasks_are_numbered_over_all_episodes(dataset: Path) -> None:
    tasks = {line["task_index"]: line["task"] for line in lines(dataset / "meta/tasks.jsonl")}
    stats = lines(dataset / "meta/episodes_stats.jsonl")
    before = 0
    for number, episode in enumerate(SEEN):
        table = parquet.read_table(dataset / f"data/chunk-000/episode_{number:06d}.parquet").to_pydict()
        for name, values in episode.vectors.items():
            np.testing.assert_array_equal(np.array(table[name], dtype=np.float32), values)
            np.testing.assert_allclose(stats[number]["stats"][name]["std"], values.std(axis=0), rtol=1e-5)
        assert table["index"] == [*range(before, before + episode.frames)]
        assert {tasks[index] for index in table[DESCRIPTION]} == {episode.task}
        assert table["task_index"] == table[DESCRIPTION]
        assert table["timestamp"][-1] == pytest.approx((episode.frames - 1) / episode.fps)
        before += episode.frames
    assert lines(dataset / "meta/episodes.jsonl")[1] == {"episode_index": 1, "tasks": ["circle"], "length": 25}
    info = json.loads((dataset / "meta/info.json").read_text())
    assert (info["codebase_version"], info["total_frames"], info["total_videos"]) == ("v2.1", 125, 6)
    assert set(table) == {name for name, feature in info["features"].items() if feature["dtype"] != "video"}


def test_subtasks_are_an_annotation_of_gr00t_and_are_listed_as_tasks(tmp_path: Path) -> None:
    told = [
        replace(seen, cameras={}, subtasks=of.subtasks, subtask=of.subtask) for seen, of in zip(SEEN, TOLD, strict=True)
    ]
    made = export("lerobot-v2.1", told, tmp_path, ["1", "2", "3"])
    tasks = {line["task_index"]: line["task"] for line in lines(made / "meta/tasks.jsonl")}
    assert list(tasks.values()) == ["stack", "circle", "reach", "grasp the cube", "place"]
    named = []
    for number in range(3):
        table = parquet.read_table(made / f"data/chunk-000/episode_{number:06d}.parquet").to_pydict()
        named.append([tasks[index] for index in table[SUBTASK_DESCRIPTION]])
        assert {tasks[index] for index in table[DESCRIPTION]} == {told[number].task}
    assert named[0] == ["reach"] * 15 + ["grasp the cube"] * 25
    assert named[1] == ["grasp the cube"] * 10 + ["place"] * 15
    assert set(named[2]) == {"stack"}, "an episode without subtasks is one with the name of its task"
    annotations = json.loads((made / "meta/modality.json").read_text())["annotation"]
    assert list(annotations) == ["human.action.task_description", "human.action.subtask_description"]
    features = json.loads((made / "meta/info.json").read_text())["features"]
    assert features[SUBTASK_DESCRIPTION] == {"dtype": "int64", "shape": [1], "names": None}


def test_the_readme_names_the_unit_of_every_number(dataset: Path) -> None:
    card = (dataset / "README.md").read_text()
    joints = "left_A1, left_A2, right_A1, right_A2 [rad]; left_gripper, right_gripper [0 closed .. 1 open]"
    assert f"| `action` | {joints} |" in card
    assert "| `intervention` | left, right [0 or 1] |" in card
    assert "3 episodes at 30 frames a second" in card
    assert "timestamp" not in card


def test_the_readme_has_lerobots_names_and_tells_that_actions_are_of_later_frames(tmp_path: Path) -> None:
    features = {
        "action": {"dtype": "float32", "names": ["left_A1.pos", "left_gripper.pos"]},
        "action.tool": {"dtype": "float32", "names": ["left_x", "left_qw"]},
        "action.tool_delta": {"dtype": "float32", "names": ["left_x", "left_rx"]},
        "observation.effort": {"dtype": "float32", "names": ["left_A1"]},
        "timestamp": {"dtype": "float32", "names": None},
    }
    write_card({"robot_type": "two_arms", "fps": 10, "features": features}, [{"action_ahead_frames": 2}], tmp_path)
    card = (tmp_path / CARD).read_text()
    for row in (
        "`action` | left_A1.pos [rad]; left_gripper.pos [0 closed .. 1 open]",
        "`action.tool` | left_x [m]; left_qw [quaternion]",
        "`action.tool_delta` | left_x [m]; left_rx [rad]",
        "`observation.effort` | left_A1 [Nm]",
        "`action` and `action.tool` of frame k + 2",
    ):
        assert row in card


def test_the_video_of_a_camera_has_openpis_name_for_the_camera_and_shows_every_frame_at_its_time(dataset: Path) -> None:
    for camera, name in (("front", "cam_high"), ("hand", "cam_left_wrist")):
        file = dataset / f"videos/chunk-000/observation.images.{name}/episode_000001.mp4"
        with av.open(str(file)) as video:
            shown = [(frame.time, frame.to_ndarray(format="rgb24")) for frame in video.decode(video=0)]
        assert [time for time, _ in shown] == pytest.approx([frame / 30 for frame in range(25)], abs=1e-4)
        for (_, found), wanted in zip(shown, SEEN[1].cameras[camera], strict=True):
            assert found.shape == (HEIGHT, WIDTH, 3)
            assert np.abs(found.astype(float) - wanted).mean() < 6


def test_modality_json_says_which_numbers_of_state_and_action_belong_to_which_part_of_the_robot(dataset: Path) -> None:
    modality = json.loads((dataset / "meta/modality.json").read_text())
    for what in ("state", "action"):
        cut = {name: POSITIONS[part["start"] : part["end"]] for name, part in modality[what].items()}
        assert cut == {
            "left_arm": ("left_A1", "left_A2"),
            "right_arm": ("right_A1", "right_A2"),
            "left_gripper": ("left_gripper",),
            "right_gripper": ("right_gripper",),
        }
    assert modality["video"]["cam_high"] == {"original_key": "observation.images.cam_high"}
    assert modality["annotation"] == {"human.action.task_description": {}}


def test_the_config_for_openpi_is_valid_python_and_leaves_grippers_absolute(dataset: Path) -> None:
    config = openpi_config(dataset)
    ast.parse(config)
    assert "make_bool_mask(4, -2)" in config
    assert '"cam_left_wrist": "observation.images.cam_left_wrist"' in config
    assert "cam_right_wrist" not in config


def camera(**where: str) -> CameraConfig:
    return CameraConfig.model_validate(
        where if "topic" in where else {"position": (1, 0, 1), "rpy": (0, 0, 0), **where}
    )


@pytest.mark.parametrize(
    ("cameras", "names"),
    [
        pytest.param(
            {"a": camera(link="left_tool"), "b": camera(link="right_tool"), "c": camera()},
            {"a": "cam_left_wrist", "b": "cam_right_wrist", "c": "cam_high"},
            id="by link",
        ),
        pytest.param(
            {"left_view": camera(topic="/a"), "front": camera(topic="/b"), "side": camera(topic="/c")},
            {"left_view": "cam_left_wrist", "front": "cam_high", "side": "side"},
            id="by name where a link is not known, and one of each",
        ),
        pytest.param(
            {"front": camera(), "cam_high": camera()},
            {"front": "front", "cam_high": "cam_high"},
            id="a name of openpi's stays",
        ),
    ],
)
def test_a_camera_gets_the_name_that_openpi_uses_for_a_wrist_camera_or_a_high_camera(
    cameras: Mapping[str, CameraConfig], names: dict[str, str]
) -> None:
    assert openpi_names({name: Waves(1, 0, config=config) for name, config in cameras.items()}) == names  # type: ignore[misc]


def test_without_pyarrow_one_line_says_how_to_install_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lerobot_v21, "find_spec", lambda name: None)
    (tmp_path / "a.mcap").touch()
    result = q2r2("export", "lerobot-v2.1", str(tmp_path / "a.mcap"), "--output", str(tmp_path / "out"))
    assert (result.exit_code, result.stderr.count("\n")) == (2, 1)
    assert install_line("export") in result.stderr


def test_the_example_ahead_py_shifts_the_actions_of_each_episode_and_changes_nothing_else(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["ahead.py", str(dataset), str(tmp_path / "ahead")])
    load_script("examples/learning/ahead.py").main()
    for number, episode in enumerate(SEEN):
        name = f"data/chunk-000/episode_{number:06d}.parquet"
        before, after = (parquet.read_table(folder / name) for folder in (dataset, tmp_path / "ahead"))
        rows = episode.vectors["action"]
        np.testing.assert_array_equal(np.array(after["action"].to_pylist(), np.float32), [*rows[1:], rows[-1]])
        assert before.drop(["action"]).equals(after.drop(["action"]))
        assert before.schema == after.schema


def test_the_example_ahead_py_repeats_the_last_action_of_each_episode_if_a_table_has_several_episodes() -> None:
    table = pa.table({"action": [0, 1, 2, 10, 11], "episode_index": [0, 0, 0, 1, 1]})
    shifted = load_script("examples/learning/ahead.py").shifted
    assert shifted(table, 1)["action"].to_pylist() == [1, 2, 2, 11, 11]
    assert shifted(table, 5)["action"].to_pylist() == [2, 2, 2, 11, 11]
