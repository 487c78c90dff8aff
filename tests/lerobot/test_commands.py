"""The commands of lerobot in simulated time, with a cell as the robot and hands of q2r2 as the teleoperator.

Run by ``make test-lerobot``, in an environment of its own.
"""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

pytest.importorskip("lerobot", reason="make test-lerobot installs it")
pytest.importorskip("lerobot_teleoperator_q2r2", reason="make test-lerobot installs it")

from lerobot.datasets.lerobot_dataset import LeRobotDataset

from q2r2_control.export.sampling import features, sample
from q2r2_control.quaternions import turn_between
from q2r2_control.recording.reader import Recording
from q2r2_control.recording.recorded_ticks import cell_and_robot_of
from q2r2_control.recording.tick_rows import Rows
from q2r2_control.types import Array
from tests.lerobot import hands
from tests.recording.runs import ROOT
from tests.support.modules import blocks_of

FPS = 25  # At this rate, each frame has a whole number of ticks.
TAKEOVERS = 100
SPACE, TAB, ESCAPE = b" ", b"\t", b"\x1b"
PACED = f"--fps={FPS}"
# True if lerobot-rollout is installed. Otherwise lerobot-record is used, which has no takeovers.
ROLLS_OUT = Path(sys.executable).with_name("lerobot-rollout").exists()


def command(program: str, folder: Path, *options: str) -> list[str]:
    """Return a command of lerobot whose robot is a cell. Its run is recorded in ``folder``."""
    robot = {"type": "q2r2_cell", "cell": folder / "cell.yaml", "simulated_time": "true", "rate": FPS}
    robot |= {"record": folder / "recordings"}
    return [str(Path(sys.executable).with_name(program)), *(f"--robot.{key}={robot[key]}" for key in robot), *options]


def dataset_options(folder: Path, name: str) -> list[str]:
    told = {"repo_id": f"q2r2/{name}", "root": folder / name, "fps": FPS, "single_task": "to wave"}
    return [*(f"--dataset.{option}={value}" for option, value in told.items()), "--dataset.push_to_hub=false"]


HANDS = ("--teleop.type=q2r2_hands", "--teleop.input=scripted", "--teleop.options={trajectory: circle}")


def environment(folder: Path) -> dict[str, str]:
    # The command needs no sounds and no window, because nobody sees its terminal.
    known = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    return known | {"PYTHONPATH": f"{folder}:{ROOT}", "MUJOCO_GL": "egl"}


def run(arguments: list[str], folder: Path) -> None:
    done = subprocess.run(arguments, cwd=folder, env=environment(folder), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]


CHANGES = {
    "loop_rate_hz: auto": "loop_rate_hz: 100.0",  # These tests need no higher rate.
    "max_substep: 0.002": "max_substep: 0.01",
}


# An ACT policy needs pictures. They are small, because a computer without a graphics card draws them slowly.
CAMERA = "{position: [1.9, 0.0, 1.0], look_at: [0.4, 0.0, 0.3], width: 64, height: 48, rate: 25}"
SEEN = f"{{front: {CAMERA}}}"


def write_cell(folder: Path, changes: dict[str, str], cameras: str = "{}") -> Path:
    text = (ROOT / "config/dual_iiwa7.yaml").read_text()
    text = re.sub(r"(?ms)^cameras:.*?(?=^judge:)", f"cameras: {cameras}\n\n", text)
    for old, new in changes.items():
        assert text.count(old) == 1
        text = text.replace(old, new)
    (folder / "cell.yaml").write_text(text)
    return folder / "cell.yaml"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with a cell."""
    write_cell(tmp_path, CHANGES)
    return tmp_path


@pytest.fixture
def seen(tmp_path: Path) -> Path:
    """Return a folder with a cell that has a camera, and with hands that take over."""
    write_cell(tmp_path, CHANGES, SEEN)
    hands.installed(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the dataset of a run in which the hands move in circles."""
    folder = tmp_path_factory.mktemp("exported")
    q2r2, recordings = [sys.executable, "-m", "q2r2_control"], str(folder / "recordings")
    scripted = ["--input", "scripted", "--trajectory", "circle", "--fast", "--duration", "4", "--headless"]
    run([*q2r2, "run", str(write_cell(folder, CHANGES, SEEN)), *scripted, "--record", recordings], folder)
    run([*q2r2, "export", "lerobot", recordings, "--output", str(folder / "dataset"), "--fps", str(FPS)], folder)
    return folder / "dataset"


@pytest.fixture(scope="module")
def trained(exported: Path) -> Path:
    """Return a small policy that lerobot-train has trained for 100 steps on the dataset of :func:`exported`."""
    given = {"dataset.repo_id": "q2r2/circle", "dataset.root": exported, "output_dir": exported.with_name("act")}
    given |= {"policy.type": "act", "policy.device": "cpu", "policy.push_to_hub": "false", "steps": 100}
    given |= {"policy.chunk_size": 10, "policy.n_action_steps": 10, "policy.dim_model": 32, "policy.n_heads": 2}
    given |= {"policy.dim_feedforward": 32, "policy.n_encoder_layers": 1, "policy.use_vae": "false"}
    given |= {"policy.pretrained_backbone_weights": "null", "dataset.video_backend": "pyav"}
    given |= {"batch_size": 1, "num_workers": 0, "save_freq": 100, "wandb.enable": "false"}
    program = str(Path(sys.executable).with_name("lerobot-train"))
    run([program, *(f"--{name}={value}" for name, value in given.items())], exported.parent)
    return exported.with_name("act") / "checkpoints/last/pretrained_model"


def default_interrupt() -> None:
    """Restore the default action of Ctrl-C. Background jobs of a shell ignore Ctrl-C, and Python inherits this."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


class Terminal:
    """A program in its own terminal. The test reads its lines one by one, and presses keys."""

    def __init__(self, arguments: list[str], folder: Path) -> None:
        self._controller, terminal = pty.openpty()
        out, told = os.pipe()
        self._process = subprocess.Popen(
            arguments,
            cwd=folder,
            env=environment(folder),
            stdin=terminal,
            stdout=told,
            stderr=told,
            preexec_fn=default_interrupt,
        )
        os.close(told)
        os.close(terminal)
        self._seen: list[str] = []
        self._lines = self._read(out)

    def _read(self, out: int) -> Iterator[str]:
        with os.fdopen(out, errors="replace") as stream:
            for line in stream:
                self._seen.append(line)
                yield line

    def wait(self, text: str, times: int = 1) -> None:
        for _ in range(times):
            found = any(text in line for line in self._lines)
            assert found, "".join(self._seen[-60:])

    def press(self, key: bytes) -> None:
        os.write(self._controller, key)

    def interrupt(self) -> None:
        self._process.send_signal(signal.SIGINT)

    def finish(self) -> None:
        for _ in self._lines:
            pass
        assert self._process.wait() == 0, "".join(self._seen[-60:])
        os.close(self._controller)


def recording_of(folder: Path) -> Recording:
    (file,) = (folder / "recordings").glob("*/*.mcap")
    return Recording(file)


def column(dataset: LeRobotDataset, name: str) -> Array:
    return np.stack([np.atleast_1d(value) for value in dataset.hf_dataset.with_format("numpy")[name]])


def rows_of(folder: Path) -> Rows:
    return np.concatenate([chunk.rows for chunk in recording_of(folder).chunks()])


def test_the_command_lerobot_teleoperate_lets_the_scripted_hands_move_the_arms(folder: Path) -> None:
    terminal = Terminal(command("lerobot-teleoperate", folder, PACED, *HANDS), folder)
    terminal.wait("Teleop loop time", 2 * FPS)
    terminal.interrupt()
    terminal.finish()
    rows = rows_of(folder)
    assert (rows["arms"]["engaged"][-1] == 1.0).all()
    assert (rows["arms"]["policy"] == 0.0).all()
    assert np.ptp(rows["q"], axis=0).max() > 0.01


def test_a_dataset_that_lerobot_records_has_the_same_numbers_as_an_export_of_the_same_run(folder: Path) -> None:
    more = ("--dataset.num_episodes=1", "--dataset.episode_time_s=10", "--play_sounds=false")
    run(command("lerobot-record", folder, *HANDS, *dataset_options(folder, "waved"), *more), folder)
    (made,) = folder.glob("waved*")
    dataset = LeRobotDataset("q2r2/waved", root=made)
    recording = recording_of(folder)
    wanted, names = features(sample(recording, FPS), cell_and_robot_of(recording)[1])
    assert len(dataset) > FPS
    for name in ("observation.state", "action"):
        assert dataset.features[name]["names"] == [f"{label}.pos" for label in names[name]]
        found = column(dataset, name)
        np.testing.assert_array_equal(found, wanted[name][: len(found)])


def test_the_command_lerobot_replay_repeats_the_motion_of_a_dataset(folder: Path, exported: Path) -> None:
    rate = 500  # Rate of the loop [Hz]. A slower loop follows a target less closely.
    write_cell(folder, {"loop_rate_hz: auto": f"loop_rate_hz: {rate}.0"})
    options = ("--dataset.repo_id=q2r2/circle", f"--dataset.root={exported}", "--dataset.episode=0")
    run(command("lerobot-replay", folder, *options, "--play_sounds=false"), folder)
    dataset = LeRobotDataset("q2r2/circle", root=exported)
    robot = cell_and_robot_of(recording_of(folder))[1]
    asked, rows = column(dataset, "action"), rows_of(folder)
    # An action arrives in the tick after it was sent, and the reference reaches it one frame after that tick.
    led = rows["reference_q"][rate // FPS + 1 :: rate // FPS]
    for arm in robot.arms:
        ways = [
            robot.tool_pose(np.float64(one[:14]), arm).actInv(robot.tool_pose(other, arm))
            for one, other in zip(asked, led, strict=False)
        ]
        apart = [(np.linalg.norm(way.translation), np.linalg.norm(pin.log3(way.rotation))) for way in ways]
        distance, angle = np.sqrt(np.mean(np.square(apart), axis=0))
        assert distance < 0.5e-3
        assert np.degrees(angle) < 0.2


def test_the_command_lerobot_rollout_lets_a_policy_that_was_trained_on_an_export_move_the_arms(
    seen: Path, trained: Path
) -> None:
    options = [f"--policy.path={trained}", "--play_sounds=false"]
    if ROLLS_OUT:
        options += ["--strategy.type=base", PACED, "--duration=4", "--task=to go round"]
    else:
        options += [*dataset_options(seen, "eval_round"), "--dataset.num_episodes=1", "--dataset.episode_time_s=4"]
    run(command("lerobot-rollout" if ROLLS_OUT else "lerobot-record", seen, *options), seen)
    assert rows_of(seen)["arms"]["policy"].any(axis=0).all()


@pytest.mark.skipif(not ROLLS_OUT, reason="lerobot has lerobot-rollout since 0.6")
def test_the_commands_in_the_docs_train_a_policy_and_let_it_act(tmp_path: Path) -> None:
    (block,) = (block for block in blocks_of("docs/policies.md", "sh") if "cell.yaml --input scripted" in block)
    (tmp_path / "config").symlink_to(ROOT / "config")
    (tmp_path / ".venv-lerobot").symlink_to(sys.prefix)
    run(["bash", "-e", "-c", block], tmp_path)
    assert "cameras: {front:" in (tmp_path / "cell.yaml").read_text()


@pytest.mark.skipif(not ROLLS_OUT, reason="lerobot has DAgger since 0.6")
def test_takeovers_in_dagger_cause_no_jump_of_a_target_and_every_frame_says_who_moved_the_arms(
    seen: Path, trained: Path
) -> None:
    dagger = ("--strategy.type=dagger", "--strategy.record_autonomous=true", "--strategy.smooth_handover=false")
    teleop = (
        "--teleop.type=q2r2_hands",
        f"--teleop.input={hands.NAME}",
        f"--policy.path={trained}",
        PACED,
    )
    options = (*dagger, *teleop, *dataset_options(seen, "rollout_corrected"), "--play_sounds=false")
    terminal = Terminal(command("lerobot-rollout", seen, *options), seen)
    for line in ("continuous recording started", "the policy has the arms"):
        terminal.wait(line)
    for _ in range(TAKEOVERS):
        for key, answer in (
            *((SPACE, "autonomous -> paused"), (TAB, "paused -> correcting"), (b"", hands.READY)),
            *((TAB, "correcting -> paused"), (b"", "the policy has the arms"), (SPACE, "paused -> autonomous")),
        ):
            terminal.press(key)
            terminal.wait(answer)
    terminal.press(ESCAPE)
    terminal.finish()
    rows = rows_of(seen)
    arms = rows["arms"]
    for arm in range(2):
        taken = np.flatnonzero(np.diff(arms["intervention"][:, arm]) > 0.0) + 1
        assert len(taken) == TAKEOVERS
        assert (arms["policy"][taken - 1, arm] == 1.0).all()
        before, after = arms["target"][taken - 1, arm], arms["target"][taken, arm]
        assert np.abs(after[:, :3] - before[:, :3]).max() <= 1e-6
        turns = [turn_between(tuple(one[3:]), tuple(other[3:])) for one, other in zip(before, after, strict=True)]
        assert np.abs(turns).max() <= 1e-6
    check_tags(LeRobotDataset("q2r2/corrected", root=next(seen.glob("rollout_corrected*"))), rows)


def check_tags(dataset: LeRobotDataset, rows: Rows) -> None:
    """Check that frames are ticks of the recording in order, and that hands move the arms only in tagged frames."""
    tags, states = column(dataset, "intervention").ravel(), column(dataset, "observation.state")
    by_hand = rows["arms"]["intervention"].max(axis=1) > 0.0
    measured = np.hstack((rows["q"], rows["arms"]["opening"])).astype(np.float32)
    assert np.count_nonzero(np.diff(tags.astype(int)) > 0) == TAKEOVERS
    place = 0
    for state, tag in zip(states, tags, strict=True):
        place += int(np.argmax((measured[place:] == state).all(axis=1)))
        np.testing.assert_array_equal(measured[place], state)
        assert tag or not by_hand[place]
    assert by_hand.any()
