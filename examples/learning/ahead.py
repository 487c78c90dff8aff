"""Give each frame of a LeRobotDataset the action of a later frame, so that a policy learns the action that comes next.

    python examples/learning/ahead.py datasets/circle datasets/circle_ahead [--frames 1]

This script is for datasets of lerobot-record, which has no option for such actions. For q2r2 export, use its option
--ahead instead. The first actions of an episode are dropped, and its last action is repeated. Only these few actions
differ, so the statistics of the dataset are not computed again.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import parquet

ACTION, EPISODE = "action", "episode_index"


def shifted(table: pa.Table, frames: int) -> pa.Table:
    """Return the ``table`` with the action of row k + ``frames`` in row k. An episode's last action is repeated."""
    episodes = np.asarray(table[EPISODE])
    last = np.searchsorted(episodes, episodes, side="right") - 1
    later = np.minimum(np.arange(len(episodes)) + frames, last)
    place = table.schema.get_field_index(ACTION)
    return table.set_column(place, table.schema.field(place), table[ACTION].take(pa.array(later)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("output", type=Path, help="A folder that does not exist yet.")
    parser.add_argument("--frames", type=int, default=1)
    given = parser.parse_args()
    shutil.copytree(given.dataset, given.output)
    for file in sorted((given.output / "data").rglob("*.parquet")):
        parquet.write_table(shifted(parquet.read_table(file), given.frames), file)


if __name__ == "__main__":
    main()
