"""Adds the subtasks of episodes to a LeRobotDataset, in two forms: for older and for newer versions of lerobot.

lerobot up to 0.5 reads the column ``subtask_index``. For each frame, this column has the index of the subtask in the
table ``meta/subtasks.parquet``. lerobot from 0.6 on reads the column ``language_persistent``. At each frame, this
column has all subtasks of the episode and the times at which they begin.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from q2r2_control.export.episodes import SUBTASK, EpisodeVectors

SHARD_FILE = "meta/subtasks_of_episode.json"  # A file with one episode's subtasks until episodes are joined.
TABLE = "meta/subtasks.parquet"
_INFO = "meta/info.json"
_LANGUAGE = ("language_persistent", "language_events")
_ROLE, _STYLE = "assistant", "subtask"  # lerobot marks a subtask in its language column by these words.


def write_subtasks(episode: EpisodeVectors, folder: Path) -> None:
    """Write the subtasks of one episode into the dataset of this episode, which is in ``folder``."""
    content = {"names": episode.subtasks, "index": episode.subtask}
    (folder / SHARD_FILE).write_text(json.dumps(content), encoding="utf-8")


def read_subtasks(shards: Sequence[Path]) -> list[dict[str, Any]]:
    """Return, for each of the ``shards``, the data that :func:`write_subtasks` has written into it."""
    return [json.loads((shard / SHARD_FILE).read_text(encoding="utf-8")) for shard in shards]


def add_subtasks(episodes: Sequence[dict[str, Any]], folder: Path) -> None:
    """Add the subtasks of all ``episodes`` to the dataset in ``folder``.

    If no episode has subtasks, the dataset is not changed. Otherwise an episode without subtasks counts as one subtask
    with an empty name.
    """
    if not any(episode["names"] for episode in episodes):
        return
    import pandas as pd
    from pyarrow import parquet

    told = [one if one["names"] else {"names": [""], "index": ()} for one in episodes]
    names = list(dict.fromkeys(name for episode in told for name in episode["names"]))
    pd.DataFrame({SUBTASK: range(len(names))}, index=pd.Index(names, name="subtask")).to_parquet(folder / TABLE)
    has_language = find_spec("lerobot.datasets.language") is not None
    for file in sorted((folder / "data").rglob("*.parquet")):
        written = file.with_suffix(".part")
        with parquet.ParquetFile(file) as source:
            tables = [_with_subtasks(source.read_row_group(at), told, names) for at in range(source.num_row_groups)]
        if has_language:
            tables = [_with_language(table, told) for table in tables]
        with parquet.ParquetWriter(written, tables[0].schema) as writer:
            for table in tables:
                writer.write_table(table)
        written.replace(file)
    features = {SUBTASK: "int64"} | (dict.fromkeys(_LANGUAGE, "language") if has_language else {})
    info = json.loads((folder / _INFO).read_text(encoding="utf-8"))
    info["features"] |= {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in features.items()}
    (folder / _INFO).write_text(json.dumps(info, indent=4, ensure_ascii=False), encoding="utf-8")


def _with_subtasks(table: Any, told: Sequence[dict[str, Any]], names: Sequence[str]) -> Any:
    """Return the ``table`` of frames with one more column: the index of each frame's subtask in ``names``.

    ``told`` has the subtasks of each episode, by the episode's number.
    """
    import pyarrow as pa

    found = []
    for number, frame in _places(table):
        own = told[number]
        found.append(names.index(own["names"][own["index"][frame] if own["index"] else 0]))
    # The table's metadata is removed, because it lists the columns for the package ``datasets`` without the new column.
    return table.replace_schema_metadata(None).append_column(SUBTASK, pa.array(found, pa.int64()))


def _with_language(table: Any, told: Sequence[dict[str, Any]]) -> Any:
    """Return the ``table`` of frames with both language columns added. Every frame has all subtasks of its episode."""
    import pyarrow as pa

    row = {"role": pa.string(), "content": pa.string(), "style": pa.string(), "timestamp": pa.float32()}
    row |= {"camera": pa.string(), "tool_calls": pa.null()}
    event = {name: kind for name, kind in row.items() if name != "timestamp"}
    rows: dict[int, list[dict[str, Any]]] = {}
    for (number, frame), time in zip(_places(table), table["timestamp"].to_pylist(), strict=True):
        begun, index = rows.setdefault(number, []), told[number]["index"]
        if index and (frame == 0 or index[frame] != index[frame - 1]):
            begun.append(
                {"role": _ROLE, "content": told[number]["names"][index[frame]], "style": _STYLE, "timestamp": time}
            )
    columns: tuple[list[Any], list[Any]] = (
        [rows[number] for number, _ in _places(table)],
        [[] for _ in range(table.num_rows)],
    )
    for name, column, fields in zip(_LANGUAGE, columns, (row, event), strict=True):
        table = table.append_column(name, pa.array(column, pa.list_(pa.struct(fields))))
    return table


def _places(table: Any) -> list[tuple[int, int]]:
    """Return, for each row, the number of its episode and the number of its frame in that episode."""
    return list(zip(table["episode_index"].to_pylist(), table["frame_index"].to_pylist(), strict=True))
