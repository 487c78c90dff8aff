"""Each episode becomes a bag of its own: the messages of its time as they were recorded, and nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from rosbags.highlevel import AnyReader

from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.errors import RecordingError
from q2r2_control.recording.episode_spans import read_spans
from q2r2_control.recording.reader import Recording
from tests.cli.command import q2r2
from tests.judging.runs import RATE, hands, record_episode
from tests.judging.test_parts import BINDINGS, DURATION, controls
from tests.recording.runs import read_elsewhere

pytestmark = pytest.mark.slow

SAID_ONCE = ("/robot_description", "/q2r2/state")


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes, of which the first succeeded and the second is discarded."""
    teleop = TeleopSettings.model_validate({"bindings": BINDINGS})
    return record_episode(tmp_path_factory.mktemp("recordings"), hands(5, inputs=controls), DURATION, teleop=teleop)


@pytest.fixture(scope="module")
def bags(file: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    out = tmp_path_factory.mktemp("out") / "episodes"
    result = q2r2("export", "mcap", str(file), "--output", str(out))
    assert (result.exit_code, result.stdout) == (0, f"{out}: 2 episodes of 1 recordings\n"), result.stderr
    return sorted(out.iterdir())


def messages(path: Path) -> list[tuple[str, int, bytes]]:
    with AnyReader([path]) as reader:
        return [(connection.topic, time, bytes(data)) for connection, time, data in reader.messages()]


def test_it_has_the_messages_of_its_time_to_the_byte(file: Path, bags: list[Path]) -> None:
    assert [bag.name for bag in bags] == [f"{file.stem}-1", f"{file.stem}-3"]
    recording = Recording(file)
    first, _, third = read_spans(recording)
    every = messages(file)
    for bag, span in zip(bags, (first, third), strict=True):
        start, end = (recording.about.epoch + round(min(t, 1e6) * 1e9) for t in (span.start, span.end))
        inside = [message for message in every if start <= message[1] <= end]
        assert len(inside) > 1000
        found = messages(bag)
        assert found[-len(inside) :] == inside
        assert {topic for topic, _, _ in found[: -len(inside)]} == set(SAID_ONCE)
        assert found[0][1] == start


def test_it_is_a_bag_that_says_what_became_of_it(file: Path, bags: list[Path], tmp_path: Path) -> None:
    custom = [
        yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]["custom_data"]
        for bag in bags
    ]
    assert [data.get("success") for data in custom] == ["true", None]
    assert [(data["cut_out_of"], data["episode"]) for data in custom] == [(file.name, "1"), (file.name, "3")]
    (first, *_) = read_spans(Recording(file))
    assert read_elsewhere(bags[0], tmp_path)["/q2r2/tick"]["count"] == round((first.end - first.start) * RATE) + 1


def test_what_needs_the_whole_run_refuses_it_in_one_line(bags: list[Path], file: Path) -> None:
    with pytest.raises(RecordingError, match=f"one episode, cut out of {file.name}; allowed: the recording"):
        Recording(bags[0])
    result = q2r2("replay", str(bags[0]))
    assert result.exit_code == 2
    assert len(result.stderr.splitlines()) == 1


def test_a_bad_recording_ends_it_with_one_line_or_is_passed_over(file: Path, tmp_path: Path) -> None:
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(b"no recording")
    out = tmp_path / "out"
    result = q2r2("export", "mcap", str(file), str(bad), "--output", str(out))
    assert (result.exit_code, len(result.stderr.splitlines())) == (2, 1)
    assert result.stderr.startswith(f"q2r2: {bad}: not an MCAP file")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad.mcap"], "nothing half is left"
    damaged = tmp_path / "damaged.mcap"
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 0xFF
    damaged.write_bytes(content)
    result = q2r2("export", "mcap", str(file), str(bad), str(damaged), "--output", str(out), "--skip-bad")
    assert result.exit_code == 0
    first, second = result.stderr.splitlines()
    assert first.startswith(f"skipped: {bad}")
    assert second.startswith(f"skipped: {damaged}: damaged: ")
    assert len(list(out.iterdir())) == 2
