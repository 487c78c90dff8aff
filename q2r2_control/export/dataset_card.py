"""Writes the README of a LeRobotDataset, with the units of its numbers, which the format itself does not store."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from q2r2_control.export.sampling import units_of

CARD = "README.md"
POSITION = ".pos"
"""lerobot expects that the name of each number in the state and the action of a LeRobotDataset ends with this."""
SOURCES = "meta/recordings.json"
"""The file in a LeRobotDataset with the recording and the notes of each episode. lerobot does not read it."""


def write_card(info: Mapping[str, Any], sources: Sequence[Mapping[str, Any]], folder: Path) -> None:
    """Write the README of the dataset in ``folder``.

    Args:
        info: The content of the dataset's ``info.json``.
        sources: The entries of its episodes in :data:`SOURCES`.
        folder: The folder of the dataset.
    """
    vectors = {name: feature["names"] for name, feature in info["features"].items() if _is_vector(feature)}
    ahead = sources[0].get("action_ahead_frames", 0)
    later = f" The row of frame k has `action` and `action.tool` of frame k + {ahead}." if ahead else ""
    lines = [
        "---\ntags:\n- LeRobot\n- q2r2_control\n---\n",
        f"# {info['robot_type']}\n",
        f"{len(sources)} episodes at {info['fps']} frames a second, made by `q2r2 export`.{later}",
        f"`{SOURCES}` says which recording each episode is of. `lerobot-edit-dataset` makes datasets without it.\n",
        "| feature | numbers, in their order, with their units |",
        "|---|---|",
        *(f"| `{feature}` | {_numbers(feature, labels)} |" for feature, labels in vectors.items()),
    ]
    (folder / CARD).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _is_vector(feature: Mapping[str, Any]) -> bool:
    return feature["dtype"] == "float32" and isinstance(feature["names"], list | tuple)


def _numbers(feature: str, labels: Sequence[str]) -> str:
    """Return the ``labels`` with their units as one text.

    If successive labels have the same unit, the unit stands only once, after the last of these labels.
    """
    plain = tuple(label.removesuffix(POSITION) for label in labels)
    units = units_of({feature: plain})[feature]
    runs = groupby(zip(labels, units, strict=True), key=lambda pair: pair[1])
    return "; ".join(f"{', '.join(label for label, _ in run)} [{unit}]" for unit, run in runs)
