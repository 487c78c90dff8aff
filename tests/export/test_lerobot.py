"""What is said of a LeRobotDataset before the package lerobot is asked; tests/lerobot has the rest."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from q2r2_control.errors import RecordingError
from q2r2_control.export import lerobot
from q2r2_control.export.lerobot import SOURCES, join_shards, video_key
from tests.cli.command import q2r2
from tests.export.vectors import CAMERA

ACTION = {"dtype": "float32", "shape": [2], "names": ["left_A1", "left_A2"]}
OTHER_ACTION = {**ACTION, "names": ["left_A1", "left_A3"]}
VIDEO = {"dtype": "video", "shape": [48, 64, 3]}


def shard(folder: Path, recording: str, cell: str, features: dict[str, Any]) -> Path:
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps({"robot_type": cell, "features": features}))
    (folder / SOURCES).write_text(json.dumps([{"recording": recording}]))
    return folder


@pytest.mark.parametrize(
    ("cell", "features", "what"),
    [
        pytest.param("one_arm", {"action": ACTION}, r"of cell one_arm, but a\.mcap of two_arms", id="another cell"),
        pytest.param("two_arms", {"action": OTHER_ACTION}, r"action has not the numbers", id="another joint"),
        pytest.param("two_arms", {"action": ACTION, video_key(CAMERA): VIDEO}, "has not the cameras", id="a camera"),
    ],
)
def test_episodes_of_different_robots_are_not_one_dataset(
    cell: str, features: dict[str, Any], what: str, tmp_path: Path
) -> None:
    shards = [
        shard(tmp_path / "a", "a.mcap", "two_arms", {"action": ACTION}),
        shard(tmp_path / "b", "b.mcap", cell, features),
    ]
    with pytest.raises(RecordingError, match=rf"b\.mcap: {what}"):
        join_shards(shards, tmp_path / "made")
    assert not (tmp_path / "made").exists()


def test_without_lerobot_one_line_says_how_to_install_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lerobot, "find_spec", lambda name: None)
    (tmp_path / "a.mcap").touch()
    result = q2r2("export", "lerobot", str(tmp_path / "a.mcap"), "--output", str(tmp_path / "out"))
    assert result.exit_code == 2
    assert result.stderr == "q2r2: export lerobot needs lerobot: pip install 'q2r2_control[lerobot]'\n"
    assert not list(tmp_path.glob("out*"))
