"""The whole loop in simulated time: limits at every tick, repeatability, and the parts of a pipeline."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from q2r2_control.config.cell_file import load_config
from q2r2_control.config.control import ContactPair
from q2r2_control.control.qp import QpProblem, QpSolution
from q2r2_control.control.solvers.daqp import DaqpSolver
from q2r2_control.errors import ConfigError, PlantError
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.run_summary import RunSummary
from q2r2_control.types import SIDES, Array, HandInputs, HandSample
from tests.pipeline.loops import FreezingLoop, pipeline
from tests.support.processes import Watch, assert_torque_bounds, cell, changes, speed


class Counting:
    """Counts its calls. It is a constraint that holds left_A3, a task with a cost of zero, and a solver."""

    hard = True

    def __init__(self) -> None:
        self.asked = {"rows": 0, "cost": 0, "solve": 0}

    def rows(self, q: Array, v: Array) -> tuple[Array, Array]:
        self.asked["rows"] += 1
        row = np.eye(len(q))[2:3]
        return np.concatenate([row, -row]), np.zeros(2)

    def cost(self, q: Array, v: Array) -> tuple[Array, Array]:
        self.asked["cost"] += 1
        return np.zeros((len(q), len(q))), np.zeros(len(q))

    def solve(self, problem: QpProblem) -> QpSolution:
        self.asked["solve"] += 1
        return DaqpSolver(len(problem.g)).solve(problem)


@pytest.mark.slow
def test_a_loop_calls_a_programs_own_tasks_constraints_and_solver_at_every_tick_of_each_run() -> None:
    own = Counting()
    config = cell().model_copy(update={"loop_rate_hz": 500.0})
    loop = Pipeline.from_config(
        config, input=ScriptedInput("circle"), plant="kinematic", solver=own, tasks=[own], constraints=[own]
    )
    speeds: list[Array] = []
    loop.listeners.append(lambda tick: speeds.append(np.abs(tick.reference.v)))
    for _ in range(2):  # Each run in simulated time may have its own controller.
        own.asked = dict.fromkeys(own.asked, 0)
        loop.run(1.8, realtime=False)
        assert min(own.asked.values()) >= 900
    fastest = np.max(speeds, axis=0)
    assert fastest[2] < 1e-3
    assert fastest[3] > 0.01


def test_a_solver_that_a_program_names_replaces_the_solver_of_the_cell() -> None:
    loop = Pipeline.from_config(cell(), input=ScriptedInput("circle"), plant="kinematic", solver="osqp")
    assert loop.controller.settings.solver == loop.config.control.solver == "osqp"
    with pytest.raises(ConfigError, match=r"control\.solver = 'nosuch'"):
        Pipeline.from_config(cell(), input=ScriptedInput("circle"), plant="kinematic", solver="nosuch")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("trajectory", "human", "plant", "mode", "degrees"),
    [
        pytest.param("meet", False, "kinematic", "position", 0.3, id="meet"),
        pytest.param("circle", True, "mujoco", "position", 0.5, id="a human's circle"),
        pytest.param("circle", True, "mujoco", "torque", 0.5, id="a human's circle by torque"),
        pytest.param("rotate", False, "mujoco", "torque", 0.5, id="rotate by torque"),
    ],
)
def test_both_arms_follow_within_every_limit(
    trajectory: str, human: bool, plant: str, mode: str, degrees: float
) -> None:
    loop = pipeline(ScriptedInput(trajectory, human=human, seed=3), plant, mode)
    watch = Watch(loop)
    summary = loop.run(2.4, realtime=False)
    assert summary.ticks == len(watch.ticks) >= 1200
    assert summary.fallback_ticks == summary.uncertified_ticks == summary.rejected_targets == 0
    assert summary.at_rest
    for arm in SIDES:
        assert changes(summary.events, arm) == [("idle", "engaged", "pressed")]
        figures = summary.arms[arm]
        assert figures.engaged_s == pytest.approx(2.4 - 0.68, abs=0.05)
        assert figures.position_error_mm_rms is not None
        assert figures.rotation_error_deg_rms is not None
        assert figures.position_error_mm_rms < 2.0
        assert figures.rotation_error_deg_rms < degrees
        assert len(watch.engagements(arm)) == 1
        assert_begins_at_the_tool(watch, arm)
        travelled = [tick.tools[arm].translation for tick in watch.ticks]
        assert np.ptp(travelled, axis=0).max() > 0.01 or trajectory == "rotate"
    assert max(map(speed, watch.ticks)) > 0.05
    if mode == "torque":
        assert_torque_bounds(loop, watch.ticks)


def assert_begins_at_the_tool(watch: Watch, arm: str) -> None:
    """Assert that the first target of every engagement is at the tool."""
    for index in watch.engagements(arm):
        tick = watch.ticks[index]
        pose = tick.targets[arm].pose
        assert pose is not None
        assert np.linalg.norm(pose.translation - tick.tools[arm].translation) < 1e-6


@pytest.mark.slow
def test_two_simulated_runs_on_the_same_pipeline_are_equal_bit_for_bit() -> None:
    def run(loop: Pipeline) -> tuple[list[bytes], RunSummary]:
        watch = Watch(loop)
        loop.input = ScriptedInput("circle", human=True, seed=1)
        summary = loop.run(1.5, realtime=False)
        loop.listeners.clear()
        bits = [b"".join((x.reference.q.tobytes(), x.reference.v.tobytes(), x.state.q.tobytes())) for x in watch.ticks]
        return bits, summary

    loop = pipeline(plant="mujoco", mode="torque")
    (first, one), (again, two) = run(loop), run(loop)
    assert first == again
    assert one.events == two.events
    assert [without_times(one), without_times(two)] == [without_times(one)] * 2


def without_times(summary: RunSummary) -> str:
    """Return a summary as JSON without the figures that depend on the machine's speed."""
    data = summary.as_json()
    del data["tick_us"], data["loop_rate_hz"], data["real_time_factor"]
    return json.dumps(data)


@pytest.mark.slow
def test_no_arm_is_engaged_at_the_start_of_a_run_even_if_the_last_run_ended_with_engaged_arms() -> None:
    loop = pipeline()
    assert loop.run(2.0, realtime=False).arms["left"].engaged_s > 1.0
    for realtime in (False, True):
        loop.input = ScriptedInput("circle")
        watch = Watch(loop)
        summary = loop.run(0.3, realtime=realtime)
        assert not summary.events
        assert max(map(speed, watch.ticks)) < 1e-6
        loop.listeners.clear()


def test_runs_in_real_time_keep_the_solvers_time_limit_and_simulated_runs_have_no_limit() -> None:
    loop = pipeline()
    assert loop.config.control.solve_time_limit is not None
    for realtime, expected in ((False, None), (True, loop.config.control.solve_time_limit), (False, None)):
        loop.run(0.05, realtime=realtime)
        assert loop.controller.settings.solve_time_limit == expected


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "may_touch"), [("position", 0), ("velocity", 0), ("torque", 1)])
def test_pairs_may_touch_only_in_torque_mode(mode: str, may_touch: int) -> None:
    contact = (ContactPair(pair=("*_finger_*", "table")),)
    control = cell().control.model_copy(update={"contact_allowed": contact})
    running = pipeline(plant="mujoco", mode=mode, control=control)
    assert len(running.controller.settings.contact_allowed) == may_touch
    running.run(0.05, realtime=False)
    assert len(running.controller.settings.contact_allowed) == may_touch


@pytest.mark.slow
@pytest.mark.parametrize("rate", [50.0, 333.0, 1000.0])
def test_a_run_takes_as_many_ticks_as_its_duration_has_periods(rate: float) -> None:
    summary = pipeline(loop_rate_hz=rate).run(0.4, realtime=False)
    assert summary.ticks == round(0.4 * rate) + 1, "and one to come to rest"
    assert summary.duration_s == pytest.approx(summary.ticks / rate)


def test_a_run_in_real_time_lasts_as_long_as_its_requested_duration() -> None:
    loop = pipeline(loop_rate_hz=100.0)
    watch = Watch(loop)
    summary = loop.run(0.5)
    times = np.array([tick.t for tick in watch.ticks])
    assert times[-1] >= 0.49
    assert summary.duration_s == pytest.approx(times[-1])
    assert summary.input_to_command_ms.p50 is not None


class HostileInput(ScriptedInput):
    """A hand that moves normally and presses buttons, with invalid samples in between."""

    def __init__(self, seed: int) -> None:
        super().__init__("circle", human=True, seed=seed, frequency_hz=1.0)
        self._random = np.random.default_rng(seed)

    def poll(self, now: float) -> list[HandSample]:
        random = self._random
        stays, self._connected = bool(random.random() > 1e-3), True
        inputs = HandInputs(button_lower=now % 0.6 < 0.2)
        samples = [replace(sample, inputs=inputs) for sample in super().poll(now)]
        self._connected = stays
        if samples and random.random() < 0.05:
            samples.append(self._invalid(samples[-1]))
        if samples and random.random() < 0.002:
            samples += [self._invalid(samples[0]) for _ in range(1000)]
        return samples

    def _invalid(self, sample: HandSample) -> HandSample:
        random, bad = self._random, (np.nan, np.inf, -np.inf, 1e308, -1e-308, 0.0)
        changes: list[dict[str, object]] = [
            {"position": np.array(random.choice(bad, 3))},
            {"position": sample.position + random.normal(0.0, 10.0 ** random.uniform(-4, 3), 3)},
            {"position": np.zeros(random.integers(0, 5))},
            {"quaternion": np.zeros(4)},
            {"quaternion": np.array(random.choice(bad, 4))},
            {"quaternion": random.normal(0.0, 1.0, 4)},
            {"hand": str(random.choice(["middle", "", "LEFT", "right"]))},
            {"pose_stamp": float(random.choice([np.nan, np.inf, -np.inf, 1e300]))},
            {"pose_stamp": sample.pose_stamp - random.exponential(1.0)},
            {"pose_stamp": sample.pose_stamp + random.exponential(1.0)},
            {"inputs_stamp": float(random.choice([np.nan, np.inf, -np.inf, -1e300]))},
            {"inputs": replace(sample.inputs, button_lower=bool(random.random() < 0.5), press_index=np.nan)},
            {"inputs": replace(sample.inputs, button_lower=True, button_upper=True)},
        ]
        return replace(sample, **changes[random.integers(len(changes))])  # type: ignore[arg-type]


@pytest.mark.slow
def test_in_five_thousand_ticks_with_hostile_samples_no_limit_is_exceeded_and_no_exception_is_raised() -> None:
    loop = pipeline(HostileInput(7))
    watch = Watch(loop)
    summary = loop.run(10.0, realtime=False)
    assert summary.ticks == len(watch.ticks) >= 5000
    json.dumps(summary.as_json(), allow_nan=False)
    assert summary.at_rest
    assert len(watch.engagements("left")) >= 5, "valid samples are followed"
    assert max(map(speed, watch.ticks)) > 0.3
    assert {event.kind for event in summary.events} >= {
        *("pose_unusable", "hand_jumped", "connection_lost", "alignment_chord")
    }
    for arm in SIDES:
        assert_begins_at_the_tool(watch, arm)


@pytest.mark.slow
def test_a_simulated_arm_stays_at_its_reference_even_if_its_torques_are_renewed_late() -> None:
    config = cell().model_copy(update={"loop_rate_hz": 500.0})
    robot = Robot.from_config(config)
    hands = ScriptedInput("circle", frequency_hz=0.5)
    loop = FreezingLoop(config, robot, hands, MujocoPlant(robot, config), "torque")
    watch = Watch(loop)
    loop.listeners.append(lambda tick: loop.freeze(0.09 if len(watch.ticks) % 100 == 0 else 0.0))
    loop.run(3.0, realtime=False)
    assert max(np.abs(tick.state.q - tick.reference.q).max() for tick in watch.ticks) < 0.02


@pytest.mark.slow
def test_ticks_that_a_program_takes_one_by_one_equal_the_ticks_of_a_run() -> None:
    watch, loop = Watch(whole := pipeline()), pipeline()
    whole.run(1.8, realtime=False)
    ran = [tick.reference.q for tick in watch.ticks][:900]
    loop.begin()
    stepped = []
    for _ in ran:
        stepped.append(loop.tick().reference.q)
        loop.check()
    loop.end()
    assert np.ptp(stepped, axis=0).max() > 0.01
    np.testing.assert_array_equal(stepped, ran)


def test_an_input_is_closed_if_single_ticks_cannot_begin(monkeypatch: pytest.MonkeyPatch) -> None:
    loop, calls = pipeline(), list[str]()
    monkeypatch.setattr(loop.input, "start", lambda: calls.append("start"))
    monkeypatch.setattr(loop.input, "close", lambda: calls.append("close"))

    def refuse(q: object = None) -> None:
        raise PlantError("no plant")

    monkeypatch.setattr(loop.plant, "reset", refuse)
    with pytest.raises(PlantError, match="no plant"):
        loop.begin()
    assert calls == ["start", "close"]


def test_single_ticks_are_refused_with_real_arms_because_nothing_would_brake_the_arms() -> None:
    loop = Pipeline.from_config(load_config("config/dual_iiwa7_fri.yaml"))
    with pytest.raises(ConfigError, match="ticks one by one: allowed with a plant that is simulated only"):
        loop.begin()
