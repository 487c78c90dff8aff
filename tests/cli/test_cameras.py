"""``q2r2 cameras`` takes a picture with each camera of a cell. It says which cameras give no picture, and why."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.cameras.videos import FPS, HEIGHT, SLOW_FPS, WIDTH, number_in, number_of_jpeg, write_video
from tests.cli.command import one_object, q2r2

CELL = Path("config/dual_iiwa7.yaml")


def cell_with(folder: Path, cameras: dict[str, object], cell: Path = CELL) -> Path:
    data = yaml.safe_load(cell.read_text(encoding="utf-8"))
    file = folder / "with_cameras.yaml"
    file.write_text(yaml.safe_dump({**data, "cameras": cameras}, sort_keys=False), encoding="utf-8")
    return file


def test_a_picture_of_each_camera_is_taken_and_each_fault_is_named(tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    write_video(tmp_path / "front.avi", [165] * 100)
    size = {"width": WIDTH, "height": HEIGHT, "rate": FPS}
    cell = cell_with(
        tmp_path,
        {
            "front": {"device": "front.avi", **size},
            "side": {"device": "/dev/video250", **size},
            "null": {"device": "/dev/null", **size},
            "net": {"device": "http://user:secret@127.0.0.1:9/stream", **size},
        },
    )
    result = q2r2("cameras", str(cell), "--output", str(tmp_path / "pictures"), "--json")
    assert result.exit_code == 1
    assert "secret" not in result.stdout
    front, side, null, net = one_object(result.stdout)["cameras"]
    assert (front["width"], front["height"], front["fault"]) == (WIDTH, HEIGHT, None)
    assert front["rate"] == pytest.approx(FPS, abs=0.1)
    assert number_of_jpeg((tmp_path / "pictures/front.jpg").read_bytes()) == 165
    assert "/dev/video250: no such device; allowed: " in side["fault"]
    assert null["fault"].endswith("/dev/null: no camera: it is no V4L2 device")
    assert "http://127.0.0.1:9/stream: no stream of pictures" in net["fault"]


@pytest.mark.slow
def test_a_run_with_a_real_camera_is_judged_and_exported_without_a_simulator(tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    write_video(tmp_path / "front.avi", range(250), fps=SLOW_FPS)
    size = {"width": WIDTH, "height": HEIGHT, "rate": SLOW_FPS}
    cell = str(cell_with(tmp_path, {"front": {"device": "front.avi", **size}}))
    options = ("--input", "scripted", "--plant", "kinematic", "--headless", "--duration", "1", "--json")
    done = q2r2("run", cell, *options, "--record", str(tmp_path / "recordings"))
    recording = one_object(done.stdout)["recording"]
    assert (recording["fault"], recording["lost_pictures"], recording["pictures"] >= SLOW_FPS) == (None, 0, True)
    fast = q2r2("run", cell, *options, "--fast", "--record", str(tmp_path / "fast"))
    assert "no pictures of front: real cameras keep real time; allowed: without --fast\n" in fast.stderr
    pytest.importorskip("h5py")
    export = ("hdf5", str(tmp_path / "recordings"), "--output", str(tmp_path / "dataset"), "--fps", "5")
    assert q2r2("export", *export, "--keep-discarded").exit_code == 0
    import h5py

    with h5py.File(tmp_path / "dataset/episode_0.hdf5") as episode:
        assert episode["observations/images/front"].shape[1:] == (HEIGHT, WIDTH, 3)


@pytest.mark.slow
@pytest.mark.usefixtures("cabinets")
def test_a_run_of_arms_behind_cabinets_is_recorded_judged_and_exported_with_a_camera(
    tmp_path: Path, fri_cell: str
) -> None:
    pytest.importorskip("cv2")
    h5py = pytest.importorskip("h5py")
    write_video(tmp_path / "front.avi", range(250), fps=SLOW_FPS)
    size = {"width": WIDTH, "height": HEIGHT, "rate": SLOW_FPS}
    cell = str(cell_with(tmp_path, {"front": {"device": "front.avi", **size}}, Path(fri_cell)))
    options = ("--input", "scripted", "--plant", "fri", "--i-know", "--full-speed", "--headless", "--duration", "2")
    done = q2r2("run", cell, *options, "--json", "--record", str(tmp_path / "recordings"))
    result = one_object(done.stdout)
    assert (result["recording"]["fault"], result["recording"]["lost_pictures"]) == (None, 0)
    (judged,) = result["judge"]
    assert judged["figures"]["cameras"]["front"]["bad_pictures"] == 0
    export = ("hdf5", str(tmp_path / "recordings"), "--output", str(tmp_path / "dataset"), "--fps", "5")
    assert q2r2("export", *export, "--keep-discarded").exit_code == 0
    with h5py.File(tmp_path / "dataset/episode_0.hdf5") as episode:
        numbers = [number_in(pixels) for pixels in episode["observations/images/front"]]
    assert len(numbers) > SLOW_FPS
    assert np.diff(numbers).min() >= 0, "the pictures are in the order of their capture"
    assert set(np.diff(numbers)) <= {0, 1, 2}


@pytest.mark.slow
def test_a_run_of_a_policy_with_a_real_camera_ends_with_one_line_if_the_camera_gives_no_picture(tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    size = {"width": WIDTH, "height": HEIGHT, "rate": FPS}
    cell = str(cell_with(tmp_path, {"front": {"device": "none.avi", **size}}))
    policy = ("--input", "policy", "--policy", "examples.policy:Circles", "--headless", "--duration", "0.2")
    opened = q2r2("run", cell, *policy, "--plant", "kinematic")
    assert opened.exit_code != 0
    assert opened.stderr.splitlines()[-1].endswith(
        "none.avi: no such file; allowed: a video, a device such as 0, an address"
    )
    fast = q2r2("run", cell, *policy, "--plant", "kinematic", "--fast")
    assert fast.exit_code == 0
    assert "no pictures of front: real cameras keep real time; allowed: without --fast\n" in fast.stderr


def test_without_a_cell_the_command_cameras_lists_the_devices_of_this_computer() -> None:
    result = q2r2("cameras")
    assert result.exit_code == 0
    assert result.stdout.startswith(("/dev/video", "no V4L2 camera on this computer\n"))
