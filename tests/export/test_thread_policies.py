"""A video is encoded by threads that have no precedence over a control loop's."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from q2r2_control.export.pictures import Pixels
from q2r2_control.export.video import encode

pytest.importorskip("av", reason="the extra export is not installed")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="scheduling is told on Linux only"),
]


def policies() -> set[int]:
    return {os.sched_getscheduler(int(entry.name)) for entry in Path("/proc/self/task").iterdir()}


def test_while_a_video_is_encoded_and_after_it_no_thread_is_put_first(tmp_path: Path) -> None:
    before, seen = policies(), set()

    def pictures() -> Iterator[Pixels]:
        for shade in range(12):
            yield np.full((64, 64, 3), 20 * shade, dtype=np.uint8)
            seen.update(policies())

    encode(pictures(), 12, tmp_path / "video.mp4", 30)
    assert seen == before
    assert policies() == before
