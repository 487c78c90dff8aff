"""The hands of a recording lead the arms of a new run, which may have other arms and another rate."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from q2r2_control.config.cell_file import load_config
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.errors import ConfigError, RecordingError
from q2r2_control.inputs.base import Input
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.recording.messages import SAMPLES, Message
from q2r2_control.recording.reader import Recording
from q2r2_control.recording.recorded_hands import RecordedHands
from q2r2_control.summary.tick import Tick
from q2r2_control.types import Array
from tests.recording.runs import RATE, file_of, pipeline, record, rewrite
from tests.support.processes import Watch, cell, changes

# The hands engage both arms at 0.6 s. From 1.2 s on they move in circles.
DURATION = 1.8  # [s]


@dataclass
class Recorded:
    file: Path
    commands: Array  # Commanded positions (ticks, joints) [rad].
    path: Array  # Path of the left tool from its start (ticks, 3) [m].


def positions(ticks: list[Tick]) -> Array:
    return np.array([tick.command.q for tick in ticks])


def path_of(ticks: list[Tick]) -> Array:
    places = np.array([tick.tools["left"].translation for tick in ticks])
    return places - places[0]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    loop = pipeline()
    watch = Watch(loop)
    file = file_of(record(tmp_path_factory.mktemp("recordings"), loop, DURATION))
    return Recorded(file, positions(watch.ticks), path_of(watch.ticks))


def played(recorded: Recorded, duration: float) -> tuple[Watch, list[str]]:
    """Let the recorded hands move the recorded cell's arms. Return the ticks, and the lines that the input printed."""
    said: list[str] = []
    loop = pipeline(source=RecordedHands(recorded.file, cell(), said.append))
    watch = Watch(loop)
    loop.run(duration, realtime=False)
    return watch, said


def test_hands_of_a_recording_move_the_same_arms_exactly_as_before(recorded: Recorded) -> None:
    watch, said = played(recorded, DURATION)
    assert np.ptp(recorded.path, axis=0).max() > 0.02
    assert np.array_equal(positions(watch.ticks), recorded.commands)
    assert said == []


def test_the_arms_pause_when_the_recording_is_over(recorded: Recorded) -> None:
    watch, said = played(recorded, DURATION + 0.5)
    events = [event for tick in watch.ticks for event in tick.events]
    assert changes(events, "left")[-1] == ("engaged", "lost", "connection_lost")
    assert said == ["the recording is over, and the arms pause"]
    (over,) = {event.t for event in events if event.destination == "lost"}
    assert over == pytest.approx(len(recorded.commands) / RATE, abs=2.0 / RATE)


def test_hands_of_a_recording_lead_other_arms_at_another_rate_along_the_same_path(recorded: Recorded) -> None:
    config = load_config("config/dual_panda.yaml").model_copy(update={"loop_rate_hz": 250.0, "cameras": {}})
    hands: Input = RecordedHands(recorded.file, config)
    loop = Pipeline.from_config(config, input=hands, plant="kinematic")
    watch = Watch(loop)
    loop.run(DURATION, realtime=False)
    path = path_of(watch.ticks)[: len(recorded.path) // 2]
    same = recorded.path[::2][: len(path)]
    assert np.linalg.norm(path - same, axis=1).max() < 5e-3


def test_recorded_hands_may_be_started_again(recorded: Recorded) -> None:
    hands = RecordedHands(recorded.file, cell())
    first = [len(hands.poll(100.0 + 0.125 * number)) for number in range(16)]
    assert sum(first) > 100
    hands.start()
    assert [len(hands.poll(500.0 + 0.125 * number)) for number in range(16)] == first


def test_samples_of_recorded_hands_have_the_times_of_the_new_run(recorded: Recorded) -> None:
    hands = RecordedHands(recorded.file, cell())
    hands.poll(1000.0)
    samples = hands.poll(1001.0)
    assert all(999.9 < sample.pose_stamp <= 1001.0 for sample in samples)
    assert all(999.9 < sample.inputs_stamp <= 1001.0 for sample in samples)


def test_a_cell_whose_hand_axes_are_not_the_recorded_axes_is_refused(recorded: Recorded) -> None:
    teleop = TeleopSettings.model_validate(cell().teleop.model_dump() | {"axes": ("+z", "-x", "+y")})
    other = cell().model_copy(update={"teleop": teleop})
    with pytest.raises(ConfigError, match=r"teleop.axes = .*'\+z', .*: allowed with .*mcap: .*'\+x', "):
        RecordedHands(recorded.file, other)


def test_a_recording_without_samples_is_refused(recorded: Recorded, tmp_path: Path) -> None:
    def without_samples(topic: str, message: Message) -> Message | None:
        return None if topic == SAMPLES else message

    file = rewrite(recorded.file, tmp_path / "empty.mcap", without_samples)
    assert Recording(file).closed
    with pytest.raises(RecordingError, match=r"empty\.mcap: no samples of hands were recorded"):
        RecordedHands(file, cell())


def test_the_input_recording_needs_the_name_of_a_recording() -> None:
    with pytest.raises(ConfigError, match="--input recording needs --recording FILE"):
        RecordedHands.from_config(cell())
