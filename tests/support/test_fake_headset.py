"""The fake headset plays what it says, so that a failure of a test that uses it is the failure of something else."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.inputs.headset import HeadsetServer
from q2r2_control.types import HandSample
from tests.support.fake_headset import DIALECTS, RATE_HZ
from tests.support.operator_script import HANDS, SCRIPTS, Reading, acceptance_script

CHECKOUT = Path(__file__).resolve().parents[2]


def session(hand: str, duration: float = 20.0) -> list[Reading]:
    script = acceptance_script(duration)
    return [script.reading(hand, index / RATE_HZ) for index in range(int(duration * RATE_HZ))]


def rotation(reading: Reading) -> np.ndarray:
    matrix: np.ndarray = pin.Quaternion(np.array(reading.quaternion)).matrix()
    return matrix


@pytest.mark.parametrize("hand", HANDS)
def test_the_operator_moves_smoothly_enough_for_any_gate(hand: str) -> None:
    for before, after in pairwise(session(hand)):
        assert math.dist(before.position, after.position) < 0.01
        assert np.linalg.norm(pin.log3(rotation(before).T @ rotation(after))) < 0.05


def test_only_the_left_hand_turns_by_120_degrees_between_pause_and_resume() -> None:
    for hand, angle in (("left", 120.0), ("right", 0.0)):
        readings = session(hand)
        presses = [
            index for index, (before, after) in enumerate(pairwise(readings)) if after.lower and not before.lower
        ]
        assert len(presses) == 3, "engage, pause, resume"
        paused, resumed = readings[presses[1]], readings[presses[2]]
        turned = np.degrees(np.linalg.norm(pin.log3(rotation(paused).T @ rotation(resumed))))
        assert turned == pytest.approx(angle, abs=1e-6)
        assert resumed.position == pytest.approx(paused.position)


def test_presses_last_120_ms_and_the_hands_press_at_different_times() -> None:
    pressed = {hand: [index for index, reading in enumerate(session(hand)) if reading.upper] for hand in HANDS}
    assert pressed["left"][0] != pressed["right"][0]
    for indices in pressed.values():
        assert len(indices) / RATE_HZ == pytest.approx(0.12, abs=1.5 / RATE_HZ)


@pytest.mark.parametrize("script", sorted(SCRIPTS))
@pytest.mark.parametrize("hand", HANDS)
def test_hands_stay_within_a_circle_of_ten_centimetres_above_where_they_began(script: str, hand: str) -> None:
    played = SCRIPTS[script](20.0)
    start = np.array(played.reading(hand, 0.0).position)
    offsets = [np.array(played.reading(hand, 0.05 * index).position) - start for index in range(400)]
    distances = [np.linalg.norm(offset - [0.0, 0.0, 0.1]) for offset in offsets]
    assert distances == pytest.approx([0.1] * 400)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_as_a_process_it_sends_what_it_logs(dialect: str, tmp_path: Path) -> None:
    log = tmp_path / "sent.jsonl"
    server = HeadsetServer(port=0)
    server.start()
    try:
        command = [sys.executable, "-m", "tests.support.fake_headset", "--port", str(server.address[1])]
        command += ["--dialect", dialect, "--duration", "0.8", "--log", str(log)]
        samples: list[HandSample] = []
        with subprocess.Popen(command, cwd=CHECKOUT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as process:
            deadline = time.monotonic() + 30.0
            while process.poll() is None and time.monotonic() < deadline:
                samples += server.poll(0.0)
                time.sleep(0.0005)
            process.kill()
            output = process.communicate()[0]
    finally:
        server.close()
    assert (process.returncode, output) == (0, b"")
    sent = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    assert len(sent) == 2 * int(0.8 * RATE_HZ)
    received = {(sample.hand, *sample.position, *sample.quaternion) for sample in samples}
    assert received <= {(line["hand"], *line["position"], *line["quaternion"]) for line in sent}
    assert {sample.hand for sample in samples} == set(HANDS)
    assert all(any(sample.hand == hand and sample.inputs.button_lower for sample in samples) for hand in HANDS)
