"""Formats of other packages are found by their names. The zarr store of plugins/ is one of them."""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from q2r2_control.errors import ConfigError, RecordingError
from q2r2_control.export.episodes import FrameSampling, make_episode
from q2r2_control.export.export_format import ExportFormat
from q2r2_control.export.formats import format_named
from tests.cli.command import q2r2
from tests.export.files import CAMERA, EPISODES, HEIGHT, TOLD, WIDTH, record_two, with_pictures
from tests.support.modules import ROOT, blocks_of, install

zarr = pytest.importorskip("zarr", reason="the store of plugins/q2r2_zarr needs it")

PLUGIN = ROOT / "plugins/q2r2_zarr"


@pytest.fixture(autouse=True)
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install two packages: plugins/q2r2_zarr, and the example in docs/extending.md.

    The first package also declares a Python object that is not a format.
    """
    group = tomllib.loads((PLUGIN / "pyproject.toml").read_text())["project"]["entry-points"]["q2r2_control.exports"]
    (declared,) = (block for block in blocks_of("docs/extending.md", "toml") if "q2r2_control.exports" in block)
    page = tomllib.loads(declared)["project"]["entry-points"]["q2r2_control.exports"]
    (code,) = (block for block in blocks_of("docs/extending.md", "python") if "ExportFormat(" in block)
    for package, source, entries in (
        ("q2r2_zarr", (PLUGIN / "q2r2_zarr/__init__.py").read_text(), group | {"no_format": "q2r2_zarr:array_name"}),
        ("my_package", code, page),
    ):
        lines = ["[q2r2_control.exports]", *(f"{name} = {at}" for name, at in entries.items())]
        install(tmp_path, package, source, "\n".join(lines))
        monkeypatch.delitem(sys.modules, package, raising=False)
    monkeypatch.syspath_prepend(tmp_path)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Sequence[Path]:
    return record_two(tmp_path_factory.mktemp("recordings"))


def read_as_replay_buffer(folder: Path) -> tuple[dict[str, Any], list[int]]:
    """Check a store as diffusion_policy's ReplayBuffer does. Return its arrays, and the ends of its episodes."""
    assert (folder / ".zgroup").exists(), "its version of zarr reads the second layout only"
    root = zarr.open(str(folder), mode="r")
    ends = root["meta"]["episode_ends"][:]
    assert ends.dtype == np.int64
    assert (np.diff(ends) > 0).all()
    arrays = {name: rows[:] for name, rows in root["data"].arrays()}
    for name, rows in arrays.items():
        assert rows.shape[0] == ends[-1], name
    return arrays, ends.tolist()


def test_a_folder_of_recordings_becomes_one_store_with_the_actions_of_the_next_frames(
    recordings: Sequence[Path], tmp_path: Path
) -> None:
    out = tmp_path / "store"
    result = q2r2("export", "zarr", *map(str, recordings), "--output", str(out))
    assert result.exit_code == 0, result.output
    arrays, ends = read_as_replay_buffer(out)
    begin = 0
    for file, end in zip(recordings, ends, strict=True):
        episode = make_episode(file, FrameSampling(ahead=1))
        for feature, name in (("observation.state", "state"), ("action", "action"), ("action.tool", "action_tool")):
            np.testing.assert_array_equal(arrays[name][begin:end], episode.vectors[feature])
        begin = end
    root = zarr.open(str(out), mode="r")
    assert root["data/action"].attrs["units"][:1] == ["rad"]
    assert root["data/action_tool"].attrs["units"][:7] == ["m"] * 3 + ["quaternion"] * 4
    assert [one["recording"] for one in root.attrs["episodes"]] == [file.name for file in recordings]
    assert {one["action_ahead_frames"] for one in root.attrs["episodes"]} == {1}


def test_a_store_has_the_pixels_of_the_picture_of_each_frame(tmp_path: Path) -> None:
    episodes, store = [with_pictures(plain, number) for number, plain in enumerate(EPISODES[:2])], format_named("zarr")
    files = [tmp_path / str(number) for number in range(2)]
    for episode, file in zip(episodes, files, strict=True):
        store.write(episode, file)
    store.join(files, tmp_path / "store")
    arrays, ends = read_as_replay_buffer(tmp_path / "store")
    assert arrays[CAMERA].shape == (ends[-1], HEIGHT, WIDTH, 3)
    assert arrays[CAMERA].dtype == np.uint8
    np.testing.assert_array_equal(arrays[CAMERA][: ends[0]], list(episodes[0].cameras[CAMERA]))
    np.testing.assert_array_equal(arrays[CAMERA][ends[0] :], list(episodes[1].cameras[CAMERA]))
    depth = f"{CAMERA}_depth"
    assert arrays[depth].dtype == np.uint16
    np.testing.assert_array_equal(arrays[depth][ends[0] :], list(episodes[1].depths[CAMERA]))
    assert zarr.open_group(str(tmp_path / "store"), mode="r")["data"][depth].attrs["unit"] == 1e-3


def test_a_store_has_the_subtask_of_each_frame_and_the_names_of_the_subtasks_of_each_episode(tmp_path: Path) -> None:
    store, files = format_named("zarr"), [tmp_path / "0", tmp_path / "1"]
    for episode, file in zip(TOLD, files, strict=False):
        store.write(episode, file)
    store.join(files, tmp_path / "store")
    arrays, _ = read_as_replay_buffer(tmp_path / "store")
    assert arrays["subtask_index"].tolist() == [0] * 15 + [1] * 25 + [0] * 10 + [1] * 15
    about = zarr.open(str(tmp_path / "store"), mode="r").attrs["episodes"]
    assert [tuple(one["subtasks"]) for one in about] == [TOLD[0].subtasks, TOLD[1].subtasks]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"cameras": {}}, f"run-2.mcap: has no {CAMERA}, which run-1.mcap has"),
        ({"names": {**EPISODES[1].names, "action": ("a",) * len(EPISODES[1].names["action"])}}, "its action differs"),
    ],
    ids=["a camera less", "other joints"],
)
def test_episodes_with_different_cameras_or_joints_are_not_joined_to_one_store(
    changes: dict[str, Any], told: str, tmp_path: Path
) -> None:
    store, files = format_named("zarr"), [tmp_path / "0", tmp_path / "1"]
    first, second = (with_pictures(plain, number) for number, plain in enumerate(EPISODES[:2]))
    store.write(first, files[0])
    store.write(replace(second, **changes), files[1])
    with pytest.raises(RecordingError, match=told):
        store.join(files, tmp_path / "store")


def test_the_example_format_in_the_docs_exports_a_recording(recordings: Sequence[Path], tmp_path: Path) -> None:
    out = tmp_path / "arrays"
    result = q2r2("export", "npz", str(recordings[0]), "--output", str(out), "--workers", "1")
    assert result.exit_code == 0, result.output
    (file,) = out.iterdir()
    episode = make_episode(recordings[0], FrameSampling())
    with np.load(file) as arrays:
        np.testing.assert_array_equal(arrays["action"], episode.vectors["action"])


def test_the_error_for_an_unknown_format_names_the_existing_formats() -> None:
    with pytest.raises(ConfigError, match=r"export zar: allowed: lerobot, .*csv, no_format, npz, zarr"):
        format_named("zar")
    with pytest.raises(ConfigError, match=r"export no_format is .*; allowed: an ExportFormat"):
        format_named("no_format")
    assert isinstance(format_named("npz"), ExportFormat)
