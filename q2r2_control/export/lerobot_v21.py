"""Writes LeRobotDataset v2.1, the layout that openpi and Isaac GR00T read. lerobot itself writes a newer layout.

Cameras have the names that openpi expects. GR00T needs ``meta/modality.json`` and the column of task descriptions.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from q2r2_control.errors import ConfigError
from q2r2_control.export.dataset_card import write_card
from q2r2_control.export.episodes import EpisodeVectors
from q2r2_control.export.lerobot import check_alike, source_of, video_key, write_sources
from q2r2_control.export.sampling import CameraFrames, Names
from q2r2_control.extras import install_line

DESCRIPTION = "annotation.human.action.task_description"  # GR00T's name of the column with the index of the task.
# The name of the column with the index of the subtask. Subtasks are in the list of tasks too.
SUBTASK_DESCRIPTION = "annotation.human.action.subtask_description"
OPENPI_CAMERAS = ("cam_high", "cam_left_wrist", "cam_right_wrist")
_ANNOTATION = "annotation."
_CHUNK = 1000  # The number of episodes in a folder.
_DATA = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
_VIDEO = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
_COUNTED = ("frame_index", "episode_index", "index", "task_index", DESCRIPTION)
_PACKED, _ABOUT = "frames.parquet", "about.json"  # The files of one episode before the episode has a number.
# All trainers can decode H.264. Every second picture is a key frame, so any single picture is decoded quickly.
_CODEC, _CODING = "libx264", {"crf": "20", "g": "2", "bf": "0"}


def require_v21() -> None:
    """Raise :class:`ConfigError` if pyarrow or av is not installed."""
    if find_spec("pyarrow") is None or find_spec("av") is None:
        raise ConfigError(f"export lerobot-v2.1 needs pyarrow and av: {install_line('export')}")


def openpi_names(cameras: Mapping[str, CameraFrames]) -> dict[str, str]:
    """Return the name of each camera in the dataset.

    One camera on each arm and one other camera get the names of openpi. All further cameras keep their names. A camera
    is on an arm if the name of its link begins with the arm's name. A camera on a ROS topic has no link. It is on an
    arm if its own name begins with the arm's name.
    """
    names = {name: name for name in cameras}
    for name, frames in cameras.items():
        carrier = name if frames.config.topic else frames.config.link or ""
        side = next((side for side in ("left", "right") if carrier.startswith(side)), None)
        wanted = "cam_high" if side is None else f"cam_{side}_wrist"
        if name not in OPENPI_CAMERAS and wanted not in names.values():
            names[name] = wanted
    return names


def write_v21(episode: EpisodeVectors, folder: Path) -> None:
    """Write the numbers and videos of one episode into ``folder``. A folder of an earlier attempt is removed first."""
    import pyarrow as pa
    from pyarrow import parquet

    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    flags = {name: values[:, None] for name, values in episode.outcome().items()}
    features: dict[str, dict[str, Any]] = {
        name: {"dtype": "float32", "shape": [len(labels)], "names": list(labels)}
        for name, labels in episode.names.items()
    }
    features |= {name: _scalar("bool") for name in flags}
    columns = episode.vectors | flags
    parquet.write_table(pa.table({name: _column(values) for name, values in columns.items()}), folder / _PACKED)
    stats = {name: _stats(values) for name, values in columns.items()}
    names = openpi_names(episode.cameras)
    for camera, shown in episode.cameras.items():
        key = video_key(names[camera])
        stats[key] = _write_video(shown, episode.fps, folder / f"{key}.mp4")
        height, width, _ = shown.size
        features[key] = _video_feature(height, width, episode.fps)
    about = {
        "robot_type": episode.cell,
        "fps": episode.fps,
        "features": features,
        "frames": episode.frames,
        "task": episode.task,
        "stats": stats,
        "modality": _modality(episode.names, [names[camera] for camera in episode.cameras]),
        "source": source_of(episode),
        "subtasks": episode.subtasks,
        "subtask": episode.subtask,
    }
    (folder / _ABOUT).write_text(json.dumps(about), encoding="utf-8")


def join_v21(shards: Sequence[Path], folder: Path) -> None:
    """Join one or more episodes in a new ``folder``. Raises :class:`RecordingError` if their features differ."""
    import pyarrow as pa
    from pyarrow import parquet

    about = [json.loads((shard / _ABOUT).read_text(encoding="utf-8")) for shard in shards]
    sources = [one["source"] for one in about]
    check_alike(about, sources)
    # Subtasks are tasks too. They come after the tasks of the episodes.
    tasks = list(dict.fromkeys([*(one["task"] for one in about), *(name for one in about for name in one["subtasks"])]))
    counted = (*_COUNTED, SUBTASK_DESCRIPTION) if any(one["subtasks"] for one in about) else _COUNTED
    modality = about[0]["modality"] | {"annotation": {_annotation(name): {} for name in counted if _annotation(name)}}
    videos = [name for name, feature in about[0]["features"].items() if feature["dtype"] == "video"]
    episodes, stats, total = [], [], 0
    for number, (shard, one) in enumerate(zip(shards, about, strict=True)):
        frames, task, at = np.arange(one["frames"]), tasks.index(one["task"]), np.ones(one["frames"], dtype=np.int64)
        columns: dict[str, npt.NDArray[Any]] = {"timestamp": (frames / one["fps"]).astype(np.float32)}
        columns |= zip(_COUNTED, (frames, number * at, total + frames, task * at, task * at), strict=True)
        if SUBTASK_DESCRIPTION in counted:  # An episode without subtasks counts as one subtask, named as its task.
            told = [tasks.index(one["subtasks"][index]) for index in one["subtask"]]
            columns[SUBTASK_DESCRIPTION] = np.array(told) if told else task * at
        table = parquet.read_table(shard / _PACKED)
        for name, values in columns.items():
            table = table.append_column(name, pa.array(values))
        place = {"episode_chunk": number // _CHUNK, "episode_index": number}
        parquet.write_table(table, _made(folder / _DATA.format(**place)))
        for key in videos:
            shutil.copyfile(shard / f"{key}.mp4", _made(folder / _VIDEO.format(video_key=key, **place)))
        episodes.append({"episode_index": number, "tasks": [one["task"]], "length": one["frames"]})
        of_columns = {name: _stats(values[:, None]) for name, values in columns.items()}
        stats.append({"episode_index": number, "stats": one["stats"] | of_columns})
        total += one["frames"]
    info = {
        "codebase_version": "v2.1",
        "robot_type": about[0]["robot_type"],
        "total_episodes": len(shards),
        "total_frames": total,
        "total_tasks": len(tasks),
        "total_videos": len(shards) * len(videos),
        "total_chunks": -(-len(shards) // _CHUNK),
        "chunks_size": _CHUNK,
        "fps": about[0]["fps"],
        "splits": {"train": f"0:{len(shards)}"},
        "data_path": _DATA,
        "video_path": _VIDEO if videos else None,
        "features": about[0]["features"]
        | {"timestamp": _scalar("float32")}
        | {name: _scalar("int64") for name in counted},
    }
    meta = folder / "meta"
    for name, content in (("info.json", info), ("modality.json", modality)):
        _made(meta / name).write_text(json.dumps(content, indent=4), encoding="utf-8")
    numbered = [{"task_index": number, "task": task} for number, task in enumerate(tasks)]
    for name, lines in (("tasks", numbered), ("episodes", episodes), ("episodes_stats", stats)):
        text = "".join(f"{json.dumps(line, ensure_ascii=False)}\n" for line in lines)
        (meta / f"{name}.jsonl").write_text(text, encoding="utf-8")
    write_sources(sources, folder)
    write_card(info, sources, folder)


def openpi_config(folder: Path) -> str:
    """Return the entry for openpi's ``src/openpi/training/config.py`` that trains on the dataset in ``folder``."""
    features = json.loads((folder / "meta" / "info.json").read_text())["features"]
    grippers = [label.endswith("_gripper") for label in features["action"]["names"]]
    mask = ", ".join(str(-len(run) if closes else len(run)) for closes, run in _runs(grippers))
    cameras = [camera for camera in OPENPI_CAMERAS if video_key(camera) in features]
    images = ", ".join(f'"{camera}": "{video_key(camera)}"' for camera in cameras)
    lacking = "" if "cam_high" in cameras else "\n# AlohaInputs needs cam_high, which is not in this dataset."
    return f"""# openpi: {len(grippers)} numbers an action; joints are made differences to the state.{lacking}
mask = _transforms.make_bool_mask({mask})
data = SimpleDataConfig(
    repo_id="q2r2/{folder.name}",  # of this folder, as $HF_LEROBOT_HOME/q2r2/{folder.name}
    base_config=DataConfig(
        prompt_from_task=True,
        action_sequence_keys=("action",),
        repack_transforms=_transforms.Group(inputs=[_transforms.RepackTransform({{
            "images": {{{images}}},
            "state": "observation.state",
            "actions": "action",
            "prompt": "prompt",
        }})]),
    ),
    data_transforms=lambda model: _transforms.Group(
        inputs=[aloha_policy.AlohaInputs(adapt_to_pi=False), _transforms.DeltaActions(mask)],
        outputs=[_transforms.AbsoluteActions(mask)],
    ),
)"""


def _annotation(column: str) -> str:
    """Return the name that GR00T gives to a column of annotations. The name is empty for any other column."""
    return column.removeprefix(_ANNOTATION) if column.startswith(_ANNOTATION) else ""


def _made(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _scalar(dtype: str) -> dict[str, Any]:
    return {"dtype": dtype, "shape": [1], "names": None}


def _column(values: npt.NDArray[Any]) -> Any:
    """Return ``values`` (n, size) as a column of lists, or as a column of plain numbers if size is 1."""
    import pyarrow as pa

    flat = pa.array(values.ravel())
    return flat if values.shape[1] == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _stats(values: npt.NDArray[Any]) -> dict[str, list[float]]:
    values = values.astype(np.float64)
    made = {what: getattr(values, what)(axis=0).tolist() for what in ("min", "max", "mean", "std")}
    return made | {"count": [len(values)]}


def _runs(values: Sequence[Any]) -> list[tuple[Any, list[int]]]:
    """Return each group of successive equal values, as the value and the indices of the group."""
    return [(value, list(places)) for value, places in groupby(range(len(values)), key=values.__getitem__)]


def _modality(names: Names, cameras: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the content of GR00T's ``modality.json`` without annotations.

    It says which numbers of state and action belong to which part of the robot, and names the videos.
    """

    def part(label: str) -> str:
        arm = next((arm for arm in names.get("intervention", ()) if label.startswith(f"{arm}_")), None)
        return label if label.endswith("_gripper") else "joints" if arm is None else f"{arm}_arm"

    parts = {
        what: {
            name: {"start": run[0], "end": run[-1] + 1}
            for name, run in _runs([part(label) for label in names[feature]])
        }
        for what, feature in (("state", "observation.state"), ("action", "action"))
    }
    shown = {camera: {"original_key": video_key(camera)} for camera in cameras}
    return {**parts, "video": shown}


def _video_feature(height: int, width: int, fps: int) -> dict[str, Any]:
    about = {"height": height, "width": width, "channels": 3, "fps": fps, "codec": "h264", "pix_fmt": "yuv420p"}
    info = {f"video.{what}": value for what, value in about.items()} | {"video.is_depth_map": False, "has_audio": False}
    return {"dtype": "video", "shape": [height, width, 3], "names": ["height", "width", "channels"], "info": info}


def _write_video(shown: CameraFrames, fps: int, path: Path) -> dict[str, Any]:
    """Encode the pictures of one camera as a video. Return the statistics of each colour, whose values are 0 .. 1."""
    import av

    height, width, _ = shown.size
    of_pictures = []
    with av.open(str(path), "w") as video:
        stream = video.add_stream(
            _CODEC, rate=fps, width=width, height=height, pix_fmt="yuv420p", options=dict(_CODING)
        )
        for pixels in shown:
            video.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
            shares = pixels.reshape(-1, 3) / 255.0
            of_pictures.append((shares.min(axis=0), shares.max(axis=0), shares.mean(axis=0), (shares**2).mean(axis=0)))
        video.mux(stream.encode())
    low, high, mean, square = np.moveaxis(np.array(of_pictures), 1, 0)
    found = {"min": low.min(axis=0), "max": high.max(axis=0), "mean": mean.mean(axis=0)}
    found["std"] = np.sqrt(np.maximum(square.mean(axis=0) - found["mean"] ** 2, 0.0))
    return {what: values.reshape(3, 1, 1).tolist() for what, values in found.items()} | {"count": [len(of_pictures)]}
