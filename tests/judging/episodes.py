"""Episodes of which every number is chosen, without a recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from q2r2_control.config.cell import Config
from q2r2_control.events import Event
from q2r2_control.judging.episode import Episode, Frames, Hand, Ticks
from q2r2_control.recording.reader import Recording
from q2r2_control.types import Array
from tests.support.processes import cell

DT = 0.002  # of the loop [s]
EVERY = 5  # ticks, a frame
ARMS = ("left", "right")


def recording() -> Recording:
    """What is asked of a recording once it is read."""
    about = SimpleNamespace(arms=ARMS, realtime=True, notes={"task": "to <stack>"})
    return cast(Recording, SimpleNamespace(about=about, closed=True, file=Path("some/where/run.mcap")))


def episode(
    seconds: float = 4.0,
    *,
    engaged: Array | None = None,
    path: Array | None = None,
    target_path: Array | None = None,
    received: Sequence[float] | Array | None = None,
    hand_path: Array | None = None,
    delay: float = 0.0,
    events: Sequence[Event] = (),
    config: Config | None = None,
    **ticks: Any,
) -> Episode:
    """Both arms do the same, and are engaged all the time, at rest and with a pose every 10 ms unless said otherwise.

    ``path`` (m, 3) is that of the tools at the frames, ``hand_path`` (k, 3) of the hands at the times ``received``
    (k,), which ticks get ``delay`` [s] later. ``ticks`` replaces columns of :class:`Ticks`.
    """
    count = round(seconds / DT)
    t: Array = DT * np.arange(1, count + 1, dtype=np.float64)
    flags = np.zeros((count, 2), dtype=bool)
    rows = Ticks(
        number=np.arange(count),
        t=t,
        dt=np.full(count, DT),
        compute_time=np.full(count, 1e-4),
        following=np.arange(count) < count - 1,
        certified=np.ones(count, dtype=bool),
        fallback=np.zeros(count, dtype=bool),
        distance=np.full(count, 0.1),
        margin=np.full(count, 0.08),
        engaged=np.ones((count, 2), dtype=bool) if engaged is None else np.stack((engaged, engaged), axis=1),
        rejected=flags,
        slip=np.zeros((count, 2)),
        slip_angle=np.zeros((count, 2)),
        gripper=np.ones((count, 2)),
    )
    frames = np.arange(0, count, EVERY)
    poses = np.tile((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), (len(frames), 2, 1))
    tools, targets = poses.copy(), poses.copy()
    if path is not None:
        tools[:, :, :3] = path[:, None]
        targets[:, :, :3] = (path if target_path is None else target_path)[:, None]
    stamps = np.arange(0.0, seconds, 0.01) if received is None else np.asarray(received)
    places = np.zeros((len(stamps), 3)) if hand_path is None else hand_path
    hands = {arm: Hand(arm, stamps, stamps + delay, places) for arm in ARMS}
    return Episode(
        recording=recording(),
        config=(config or cell()).model_copy(update={"loop_rate_hz": 1.0 / DT}),
        ticks=replace(rows, **ticks),
        frames=Frames(frames, np.zeros((len(frames), 14)), targets, tools.copy()),
        tools=tools,
        hands=hands,
        events=list(events),
        damage=None,
    )


def frame_times(seconds: float = 4.0) -> Array:
    """(m,) of an episode's frames [s]."""
    return np.asarray(DT * np.arange(1, round(seconds / DT) + 1)[::EVERY])
