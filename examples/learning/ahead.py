"""Let each frame of a LeRobotDataset have the action of a later one, as a policy should learn it.

    python examples/learning/ahead.py datasets/circle datasets/circle_ahead [--frames 1]

For datasets of lerobot-record, which has no such option; q2r2 export has --ahead. The first action of an episode goes
and its last one is repeated, so the statistics of the dataset are kept as they are.
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
    """The ``table`` with the action of so many ``frames`` later in each row, or of the last one of its episode."""
    episodes = np.asarray(table[EPISODE])
    last = np.searchsorted(episodes, episodes, side="right") - 1
    later = np.minimum(np.arange(len(episodes)) + frames, last)
    place = table.schema.get_field_index(ACTION)
    return table.set_column(place, table.schema.field(place), table[ACTION].take(pa.array(later)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("output", type=Path, help="a folder that does not exist yet")
    parser.add_argument("--frames", type=int, default=1)
    given = parser.parse_args()
    shutil.copytree(given.dataset, given.output)
    for file in sorted((given.output / "data").rglob("*.parquet")):
        parquet.write_table(shifted(parquet.read_table(file), given.frames), file)


if __name__ == "__main__":
    main()
