"""Live pictures: a separate process takes the pictures of a simulated camera. If it ends, one line says so."""

from __future__ import annotations

import io
import os
import signal

import pytest
from PIL import Image

from q2r2_control.cameras.camera_process import CameraShot
from q2r2_control.config.recording import CameraConfig
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.viewer.live_pictures import LivePictures, ShownPictures
from tests.support.processes import cell, wait_until


@pytest.mark.slow
def test_pictures_of_a_simulated_camera_are_shown_and_one_line_says_if_the_process_that_takes_them_has_ended(
    caplog: pytest.LogCaptureFixture,
) -> None:
    camera = CameraConfig(position=(1.5, 0.0, 1.0), look_at=(0.4, 0.0, 0.3), width=64, height=48)
    loop = Pipeline.from_config(cell().model_copy(update={"cameras": {"front": camera}}), plant="mujoco")
    assert isinstance(loop.plant, MujocoPlant)
    got: list[bytes] = []
    watched = False
    with LivePictures(loop.plant, "front", camera, 30.0, got.append, lambda: watched) as pictures:
        loop.begin()
        tick = loop.tick()
        pictures(tick)
        assert pictures._due == 0.0, "nobody looks, so nothing was asked for"
        watched = True

        def taken() -> bool:
            pictures(tick)
            return bool(got)

        wait_until(taken)
        os.kill(pictures._process.pid, signal.SIGKILL)
        wait_until(lambda: not pictures._process.alive)
        pictures._due = 0.0
        for _ in range(3):
            pictures(tick)
    loop.end()
    assert Image.open(io.BytesIO(got[0])).size == (64, 48)
    told = [record.message for record in caplog.records if "no more pictures are shown" in record.message]
    assert told == ["no more pictures are shown: the process that takes pictures was ended by SIGKILL"]


@pytest.mark.slow
def test_no_line_says_that_pictures_have_ended_if_their_run_has_ended(caplog: pytest.LogCaptureFixture) -> None:
    camera = CameraConfig(position=(1.5, 0.0, 1.0), look_at=(0.4, 0.0, 0.3), width=64, height=48)
    loop = Pipeline.from_config(cell().model_copy(update={"cameras": {"front": camera}}), plant="mujoco")
    assert isinstance(loop.plant, MujocoPlant)
    with LivePictures(loop.plant, "front", camera, 30.0, lambda jpeg: None, lambda: True) as pictures:
        loop.begin()
        tick = loop.tick()
    pictures(tick)
    loop.end()
    assert "no more pictures" not in caplog.text


def test_pictures_of_a_real_camera_are_shown_at_the_wanted_rate_and_only_while_somebody_watches() -> None:
    got: list[bytes] = []
    looks = True
    shown = ShownPictures(5.0, got.append, lambda: looks)
    for number in range(30):
        shown(CameraShot(10.0 + number / 30.0, 64, 48, bytes([number])))
    assert [jpeg[0] for jpeg in got] == [0, 6, 12, 18, 24]
    looks = False
    shown(CameraShot(20.0, 64, 48, b"unseen"))
    assert b"unseen" not in got
