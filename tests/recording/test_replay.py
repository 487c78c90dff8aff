"""A replay repeats a run with the same bits, and names each difference."""

from __future__ import annotations

from dataclasses import replace as changed
from pathlib import Path

import numpy as np
import pytest

from q2r2_control.config.bindings import Action
from q2r2_control.config.moving_obstacle import MovingObstacle
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.control.qp import QpProblem, QpSolution, Solver
from q2r2_control.control.solvers.daqp import DaqpSolver
from q2r2_control.errors import PlantError, RecordingError
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.judging.judge import judge
from q2r2_control.plants.kinematic import KinematicPlant
from q2r2_control.recording.messages import SAMPLES, STATE, TICK, Message
from q2r2_control.recording.reader import NO_END, Recording
from q2r2_control.recording.recorder import Recorder
from q2r2_control.recording.replay import replay
from q2r2_control.recording.tick_rows import SAMPLE_FIELDS
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick
from q2r2_control.types import QUEST_CONTROLS, DeviceControls, HandFault, HandSample, RobotState
from tests.recording.runs import RATE, file_of, number_of, pipeline, record, rewrite
from tests.support.object_cell import cell as object_cell
from tests.support.processes import cell

pytestmark = pytest.mark.slow

BOX = {"x": [0.3, 0.8], "y": [0.0, 0.6], "z": [0.1, 0.7]}


@pytest.fixture(scope="module")
def circle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording. Its hands engage both arms, and from 1.2 s on move in circles for half a second."""
    return file_of(record(tmp_path_factory.mktemp("recordings"), pipeline(), 1.8))


@pytest.mark.parametrize(
    ("trajectory", "plant", "mode", "human", "duration"),
    [
        ("line", "kinematic", "velocity", False, 1.8),
        ("rotate", "mujoco", "position", True, 1.2),
        ("meet", "mujoco", "torque", False, 2.0),
    ],
    ids=["velocities", "a human's hands in MuJoCo", "torques, grippers that close"],
)
def test_a_replay_of_a_run_in_simulated_time_is_identical(
    tmp_path: Path, trajectory: str, plant: str, mode: str, human: bool, duration: float
) -> None:
    file = file_of(record(tmp_path, pipeline(trajectory, plant, mode, human), duration))
    result = replay(file)
    assert (result.difference, result.ended_by, result.notes) == (None, None, [])
    assert result.ticks >= duration * RATE
    assert result.summary is not None
    assert result.summary.arms["left"].engaged_s > 0.3
    assert result.summary.at_rest


def test_requests_that_a_program_made_are_repeated_in_the_replay(tmp_path: Path) -> None:
    loop = pipeline("circle", "kinematic", control=cell().control.model_copy(update={"moving_obstacles": ("hand",)}))
    tool = loop.robot.tool_pose(loop.robot.home, "left").translation
    # At this position, the obstacle is so near to the arms that they slow down.
    place = tuple((tool + np.array([0.0, 0.6, 0.0])).tolist())
    changes = {"position_scale": 0.3, "workspace": {"left": BOX}, "filter": {"smoothing_delay": 0.05}}
    other = TeleopSettings.model_validate(loop.config.teleop.model_dump() | changes)
    asks = {
        0.8: lambda: loop.change_teleop(other),
        0.9: lambda: loop.move_obstacle("hand", MovingObstacle(shape="sphere", size=(0.1,), position=place, speed=1.0)),
        0.96: lambda: loop.move_obstacle("hand", None),
        1.0: lambda: loop.change_control({"min_distance": 0.03, "position_gain": 4.0}),
        1.2: loop.go_home,
        1.3: lambda: loop.mark(Action.RECORD_TOGGLE),
        1.4: loop.give_back,
        1.5: loop.pause,
    }

    def ask(tick: Tick) -> None:
        for due in [due for due in asks if tick.t >= due]:
            asks.pop(due)()

    loop.listeners.append(ask)
    result = replay(file_of(record(tmp_path, loop, 1.6)))
    assert result.summary is not None
    told = [event.reason for event in result.summary.events if event.arm == "left"]
    assert told[1].detail["changes"]["position_scale"] == 0.3
    assert told[3].detail["changes"] == {"min_distance": 0.03, "position_gain": 4.0}
    kinds = [reason.kind for reason in told[1:]]
    assert kinds[:4] == ["settings_requested", "settings_changed", "control_requested", "control_changed"]
    assert [kind for kind in kinds[4:] if "homing" not in kind] == [
        *("home_requested", "recording_requested", "episode_begins", "policy_requested", "pause_requested"),
    ]
    assert (result.difference, result.ended_by, result.notes) == (None, None, [])


def test_a_replay_of_a_run_in_real_time_is_identical(tmp_path: Path) -> None:
    loop = pipeline("circle", "mujoco", "torque", human=True)
    file = file_of(record(tmp_path, loop, 1.2, realtime=True))
    result = replay(file)
    # On a slow computer, it is possible that no arm is ever engaged, because a loop that stalls pauses the arms.
    assert (result.difference, result.ended_by) == (None, None)
    assert result.ticks > 10
    recording = Recording(file)
    first = next(chunk.times[0] for chunk in recording.chunks() if len(chunk.rows))
    assert 0 <= first - recording.about.epoch < 1_000_000_000, "Unix times, whatever the loop's clock is"


def test_a_gripper_that_held_an_object_also_holds_the_object_in_the_replay(tmp_path: Path) -> None:
    flat = {"box": (0.06, 0.04, 0.015), "at": (0.0, 0.0, 0.0085), "mass": 0.1}
    config = object_cell(None, flat)
    loop = pipeline("grasp", "mujoco", source=ScriptedInput("grasp"), arms=config.arms, mujoco=config.mujoco)
    result = replay(file_of(record(tmp_path, loop, 5.5)))
    assert result.difference is None
    assert result.summary is not None
    assert result.summary.arms["right"].object_held_s


class FaultyHands(ScriptedInput):
    """Hands with a lost connection, missing poses, unknown hands, a fault of the left hand, and a pedal."""

    controls = DeviceControls((*QUEST_CONTROLS.buttons, "pedal"), QUEST_CONTROLS.axes)

    @property
    def connected(self) -> bool:
        return super().connected and not 1.0 <= self._now < 1.02

    def poll(self, now: float) -> list[HandSample]:
        self._now = now
        samples = super().poll(now)
        if 0.9 <= now < 0.95:
            samples = [changed(sample, position=np.array([np.nan, np.inf, -0.0])) for sample in samples]
        more = {"pedal": float(now > 0.7)} if now < 1.2 else {}
        samples = [changed(one, inputs=changed(one.inputs, thumb_stick_horizontal=1e300, more=more)) for one in samples]
        faults = {"left": HandFault.FROZEN if now > 1.1 else None}
        samples = [changed(sample, fault=faults.get(sample.hand)) for sample in samples]
        return samples + [changed(sample, hand="third") for sample in samples]

    _now = 0.0


def test_a_replay_repeats_lost_connections_and_numbers_that_are_not_finite_and_faults_of_the_input(
    tmp_path: Path,
) -> None:
    teleop = TeleopSettings.model_validate({"bindings": {"device": {"pedal": "record_mark"}}})
    file = file_of(record(tmp_path, pipeline(source=FaultyHands("circle"), teleop=teleop), 1.3))
    result = replay(file)
    assert result.difference is None
    assert result.summary is not None
    samples = np.concatenate([chunk.samples for chunk in Recording(file).chunks()])
    assert set(samples[:, SAMPLE_FIELDS.index("fault")]) == {0.0, 1.0}
    assert np.isnan(samples[:, SAMPLE_FIELDS.index("x")]).any()
    assert "pose_unusable" in [event.kind for event in result.summary.events if event.destination == "lost"]
    assert "mark" in [event.kind for event in result.summary.events]


class LosesItsSensors(KinematicPlant):
    def state(self) -> RobotState:
        state = super().state()
        return changed(state, q=np.full_like(state.q, np.nan)) if state.stamp > 1.0 else state


def test_if_a_fault_ended_a_run_its_replay_ends_with_the_same_fault(tmp_path: Path) -> None:
    plant = LosesItsSensors(Robot.from_config(cell()), cell())
    recorders: list[Recorder] = []
    with pytest.raises(PlantError) as fault:
        record(tmp_path, pipeline(plant=plant), 1.5, during=recorders.append)
    file = file_of(recorders[0].summary)
    result, recording = replay(file), Recording(file)
    assert (result.difference, result.ended_by) == (None, str(fault.value))
    assert recording.closed
    assert recording.conclusion.ended_by == str(fault.value)
    (judged,) = judge(recording)
    assert f"a fault ended the run: {fault.value}" in judged.verdict.line


class SometimesLate:
    """A solver that returns no solution for every seventh problem, as if it had taken too long."""

    def __init__(self, solver: Solver) -> None:
        self._solver, self.count = solver, 0

    def solve(self, problem: QpProblem) -> QpSolution:
        self.count += 1
        solution = self._solver.solve(problem)
        return QpSolution(None, 1.0) if self.count % 7 == 0 else solution


def test_qp_solutions_that_came_too_late_in_the_run_also_come_too_late_in_the_replay(tmp_path: Path) -> None:
    loop = pipeline(control=cell().control.model_copy(update={"solve_time_limit": None}))
    loop.controller._solver = SometimesLate(DaqpSolver(loop.robot.model.nv))
    file = file_of(record(tmp_path, loop, 1.2))
    result = replay(file)
    assert result.difference is None
    assert result.summary is not None
    assert result.summary.fallback_ticks > 50


@pytest.mark.parametrize(
    ("topic", "place", "at", "said"),
    [
        (SAMPLES, SAMPLE_FIELDS.index("x"), 1.0, "left.filtered_hand.x: recorded "),
        (TICK, number_of("dt"), 1.002, "step: recorded 0.002, replayed 0.00199"),
        (STATE, 1, 1.4, "states: recorded {'left': 'dngaged', "),  # The flipped bit is in the letter e of "engaged".
    ],
    ids=["a sample", "the time of a tick", "the state in words"],
)
def test_the_replay_names_a_flipped_bit_of_the_recording_as_the_first_difference(
    tmp_path: Path, circle: Path, topic: str, place: int, at: float, said: str
) -> None:
    flipped: list[int] = []

    def flip(name: str, message: Message) -> Message:
        """Flip a low bit of one number, in the first message of the topic after one second."""
        if name != topic or message.number < 1.0 * RATE or flipped:
            return message
        flipped.append(message.number)
        payload = bytearray(message.payload)
        payload[20 + 8 * place + 1] ^= 1
        return message._replace(payload=bytes(payload))

    result = replay(rewrite(circle, tmp_path / "flipped.mcap", flip))
    assert result.difference is not None
    time, _, rest = result.difference.partition(" s: ")
    assert float(time) == pytest.approx(at, abs=0.4 if topic == STATE else 0.02)
    assert rest.startswith(said)


def _cut(file: Path, target: Path, ticks: int) -> Path:
    return rewrite(file, target, lambda _, message: message if message.number < ticks else None, whole=False)


def test_the_replay_of_a_cut_recording_summarises_the_ticks_that_are_left(circle: Path, tmp_path: Path) -> None:
    result = replay(_cut(circle, tmp_path / "cut.mcap", 400))
    assert (result.ticks, result.ended_by) == (400, NO_END)
    assert result.summary is not None
    assert result.summary.ticks == 400
    with pytest.raises(RecordingError, match=f"no tick was recorded; {NO_END}"):
        replay(_cut(circle, tmp_path / "no_tick.mcap", 0))


def test_a_file_that_is_not_a_recording_or_belongs_to_another_cell_raises_an_error_of_one_line(
    tmp_path: Path, circle: Path
) -> None:
    data = circle.read_bytes()
    damaged = bytearray(data)
    # The byte is in the content of a chunk, not in an index.
    damaged[data.rindex(b"zstd", 0, len(data) // 2) + 50] ^= 1
    contents = {
        "damaged": (bytes(damaged), "damaged: "),
        "text": (b"nothing of the kind", "not an MCAP file; allowed: a recording of q2r2 run --record$"),
        "empty": (b"", "the file is empty"),
        "other": (data.replace(b"q2r2_control", b"q9r9_control"), "not a recording of q2r2 run --record"),
    }
    for name, (content, _) in contents.items():
        (tmp_path / f"{name}.mcap").write_bytes(content)
    said = {tmp_path / f"{name}.mcap": what for name, (_, what) in contents.items()}
    for file, what in {**said, tmp_path / "none.mcap": "no such file", tmp_path: "has 4 files .mcap"}.items():
        with pytest.raises(RecordingError, match=what) as error:
            pytest.fail(f"{file} was replayed: {replay(file)}")
        assert "\n" not in str(error.value)
        assert str(file) in str(error.value)
    one_arm = cell().model_copy(update={"arms": {"left": cell().arms["left"]}})
    with pytest.raises(RecordingError, match="other arms or joints"):
        replay(circle, one_arm)
