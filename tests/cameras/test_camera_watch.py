"""A camera that stops, slows down, changes the size of its pictures, or comes back is reported once."""

from __future__ import annotations

import pytest

from q2r2_control.cameras.camera_process import Thinning
from q2r2_control.cameras.camera_watch import CameraWatch, MissingPictures
from q2r2_control.config.recording import CameraConfig
from q2r2_control.wording import sentence

CAMERA = CameraConfig(device=0, width=64, height=48, rate=20.0)
LATENCY = 0.1  # Time from the capture of a picture to its receipt [s].


def watch() -> CameraWatch:
    return CameraWatch("front", CAMERA, 100.0)


def told(watched: CameraWatch, times: list[float], width: int = 64) -> list[str]:
    """Add pictures that were captured at these times since the beginning [s]. Return all reports in words."""
    found = []
    for time in times:
        found += watched.add(100.0 + time, 100.0 + time + LATENCY, width, 48)
        found += watched.look(100.0 + time + LATENCY)
    return [sentence(reason) for reason in found]


def every(step: float, begin: float, end: float) -> list[float]:
    return [begin + step * k for k in range(round((end - begin) / step))]


def test_a_camera_with_small_jitter_is_not_reported_and_misses_no_picture() -> None:
    watched = watch()
    uneven = [time + (0.015 if at % 3 else -0.015) for at, time in enumerate(every(0.05, 0.03, 10.0))]
    assert told(watched, uneven) == []
    watched.finish(109.96)
    assert watched.missing == 0


def test_a_camera_that_stops_is_reported_once_with_the_reason_and_its_return_is_also_reported() -> None:
    watched = watch()
    told(watched, every(0.05, 0.0, 1.0))
    assert watched.look(100.95 + LATENCY + 0.99) == []
    (stopped,) = watched.look(100.95 + LATENCY + 1.01, "unplugged")
    assert sentence(stopped) == "camera front: no picture for 1.0 s: unplugged"
    assert watched.look(103.0, "unplugged") == []
    assert told(watched, every(0.05, 2.95, 5.0)) == ["camera front: pictures again after 2.0 s, 39 missing"]
    assert watched.missing == 39


def test_if_a_camera_gives_no_picture_at_all_every_due_picture_counts_as_missing() -> None:
    watched = watch()
    assert [sentence(one) for one in watched.look(101.5)] == ["camera front: no picture for 1.5 s"]
    watched.finish(102.0)
    assert watched.missing == 40


def test_a_slow_camera_is_reported_once_and_again_only_after_it_was_fast_enough() -> None:
    watched = watch()
    assert told(watched, every(0.05, 0.0, 3.0)) == []
    assert told(watched, every(0.1, 3.0, 8.0)) == ["camera front: 15.7 pictures a second instead of 20"]
    assert watched.missing == pytest.approx(50, abs=1), "every second one"
    assert told(watched, every(0.05, 8.0, 12.0)) == []
    assert len(told(watched, every(0.1, 12.0, 16.0))) == 1


def test_pictures_that_do_not_have_the_configured_size_are_reported_once() -> None:
    watched = watch()
    told(watched, every(0.05, 0.0, 1.0))
    assert told(watched, every(0.05, 1.0, 2.0), width=32) == ["camera front: pictures of 32x48; allowed: 64x48"]
    assert told(watched, every(0.05, 2.0, 3.0)) == []


def test_a_camera_whose_pictures_are_received_late_but_steadily_does_not_count_as_stopped() -> None:
    watched = watch()
    for time in every(0.05, 0.0, 3.0):
        assert watched.add(100.0 + time, 160.0 + time, 64, 48) == [] or time == 0.0
        assert watched.look(160.0 + time) == []


@pytest.mark.parametrize("fps", [20.0, 19.98, 19.8, 20.2])
@pytest.mark.parametrize("jitter", [0.0, 0.01])
def test_missing_pictures_are_counted_whatever_the_jitter_and_the_exact_rate(fps: float, jitter: float) -> None:
    lost = {30, 77, 78, 79, 200}
    missing = MissingPictures(0.0, 20.0)
    times = [0.03 + at / fps + (jitter if at % 3 else -jitter) for at in range(400) if at not in lost]
    found = sum(map(missing.add, times))
    assert (missing.count, found) == (5, 5)
    missing.finish(times[-1] + 0.21)
    assert missing.count == 5 + 4


@pytest.mark.parametrize(
    ("fps", "kept"), [(30.0, 300), (29.97, 300), (60.0, 300), (45.0, 300), (120.0, 300), (15.0, 150)]
)
def test_pictures_of_a_camera_that_is_too_fast_are_thinned_out_to_the_configured_rate(fps: float, kept: int) -> None:
    thinning = Thinning(30.0)
    times = [at / fps + (0.004 if at % 2 else 0.0) for at in range(round(10 * fps))]
    assert sum(map(thinning.keeps, times)) == pytest.approx(10.0 * min(fps, 30.0), abs=2)
