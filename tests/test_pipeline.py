"""The whole loop in simulated time: limits at every tick, repeatability, and a stop whatever ends the run."""

from __future__ import annotations

import gc
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.control import ContactPair
from q2r2_control.errors import ConfigError, InputError
from q2r2_control.inputs.headset import HeadsetServer
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.pipeline import Pipeline
from q2r2_control.pipeline.pipeline_run import STOPPING
from q2r2_control.plants.kinematic import KinematicPlant
from q2r2_control.robot.robot import Robot
from q2r2_control.runtime.recorder import Tick
from q2r2_control.runtime.run_summary import RunSummary
from q2r2_control.supervision.gripper_limiter import GripperLimiter
from q2r2_control.types import SIDES, Command, HandSample
from tests.support.object_cell import cell as object_cell
from tests.support.watch import Watch, assert_torque_bounds, cell, changes, speed

CHECKOUT = Path(__file__).resolve().parents[1]


class RecordingPlant(KinematicPlant):
    """Keeps every command, counts calls of close, and fails at a given command."""

    def __init__(self) -> None:
        super().__init__(Robot.from_config(cell()), cell())
        self.closed = 0
        self.fails_at: int | None = None
        self.commands: list[Command] = []

    def apply(self, command: Command) -> None:
        self.commands.append(command)
        if self.fails_at is not None and len(self.commands) >= self.fails_at:
            raise RuntimeError("the plant failed")
        super().apply(command)

    def close(self) -> None:
        self.closed += 1


def pipeline(
    trajectory: str = "circle", plant: str = "kinematic", mode: str = "position", **changes: object
) -> Pipeline:
    """At 500 Hz, the lowest rate with one substep a tick, since most of a test's time goes by ticks."""
    config = cell().model_copy(update={"loop_rate_hz": 500.0, **changes})
    return Pipeline.from_config(config, input=ScriptedInput(trajectory, frequency_hz=0.5), plant=plant, mode=mode)


def when_moving(action: Callable[[], object]) -> Callable[[Tick], None]:
    """A listener that acts once, in mid-motion."""
    acted: list[Tick] = []

    def listener(tick: Tick) -> None:
        if not acted and speed(tick) > 0.1:
            acted.append(tick)
            action()

    return listener


@pytest.mark.parametrize(
    ("trajectory", "human", "plant", "mode", "millimetres", "degrees"),
    [
        ("circle", False, "mujoco", "position", 2.0, 0.3),
        ("line", False, "kinematic", "position", 2.0, 0.3),
        ("rotate", False, "mujoco", "position", 2.0, 0.5),
        ("meet", False, "kinematic", "position", 2.0, 0.3),
        ("circle", True, "mujoco", "position", 2.0, 0.5),
        ("circle", True, "mujoco", "torque", 2.0, 0.5),
        ("rotate", False, "mujoco", "torque", 2.0, 0.5),
    ],
    ids=["circle", "line", "rotate", "meet", "a human's circle", "a human's circle by torque", "rotate by torque"],
)
def test_both_arms_follow_within_every_limit(
    trajectory: str, human: bool, plant: str, mode: str, millimetres: float, degrees: float
) -> None:
    source = ScriptedInput(trajectory, human=human, seed=3)
    loop = Pipeline.from_config(cell(), input=source, plant=plant, mode=mode)
    watch = Watch(loop)
    summary = loop.run(2.4, realtime=False)
    assert summary.ticks == len(watch.ticks) >= 2400
    assert summary.fallback_ticks == summary.uncertified_ticks == summary.rejected_targets == 0
    assert summary.at_rest
    for arm in SIDES:
        assert changes(summary.events, arm) == [("idle", "engaged", "lower button")]
        figures = summary.arms[arm]
        assert figures.engaged_s == pytest.approx(2.4 - 0.68, abs=0.05)
        assert figures.position_error_mm_rms is not None
        assert figures.rotation_error_deg_rms is not None
        assert figures.position_error_mm_rms < millimetres
        assert figures.rotation_error_deg_rms < degrees
        (start,) = watch.engagements(arm)
        first = watch.ticks[start]
        pose = first.targets[arm].pose
        assert pose is not None
        assert np.linalg.norm(pose.translation - first.tools[arm].translation) < 1e-6
        travelled = [tick.tools[arm].translation for tick in watch.ticks]
        assert np.ptp(travelled, axis=0).max() > 0.01 or trajectory == "rotate"
    assert max(map(speed, watch.ticks)) > 0.05
    if mode == "torque":
        assert_torque_bounds(loop, watch.ticks)


@pytest.mark.parametrize("plant", ["kinematic", "mujoco"])
def test_fingers_count_as_wide_as_the_grippers_are_at_every_tick(plant: str) -> None:
    loop = Pipeline.from_config(cell(), input=ScriptedInput("meet"), plant=plant)
    watch, widest = Watch(loop), list[float]()

    def listener(tick: Tick) -> None:
        for arm, (least, greatest) in loop.controller.openings.items():
            assert least <= tick.grippers[arm] <= greatest
        widest.append(loop.controller.openings["left"][1])

    loop.listeners.append(listener)
    summary = loop.run(5.6, realtime=False)
    # In MuJoCo the gripper has closed on a block.
    assert widest[0] == 1.0
    assert widest[-1] < 0.9
    assert widest[-1] == pytest.approx(watch.ticks[-1].grippers["left"] + 0.04, abs=0.02)
    assert summary.fallback_ticks == summary.uncertified_ticks == 0
    assert all(not figures.gripper_held_s for figures in summary.arms.values())
    assert len(watch.ticks) == len(widest)


def test_what_is_gripped_is_part_of_the_tool_until_it_is_put_down() -> None:
    """The flat block of the demo; the contract, objects included, is checked at every tick."""
    flat = {"box": (0.06, 0.04, 0.015), "at": (0.0, 0.0, 0.0085), "mass": 0.1}
    config = object_cell(None, flat)
    loop = Pipeline.from_config(config, input=ScriptedInput("grasp"), plant="mujoco")
    watch = Watch(loop)
    summary = loop.run(10.0, realtime=False)
    held = [tick.t for tick in watch.ticks if tick.holding["right"]]
    assert 4.0 < held[0] < 5.0
    assert 8.5 < held[-1] < 9.5
    assert summary.arms["right"].object_held_s == pytest.approx(held[-1] - held[0], abs=0.01)
    assert summary.arms["left"].object_held_s is None
    assert summary.fallback_ticks == summary.uncertified_ticks == 0
    jumps = [np.abs(second.reference.v - first.reference.v).max() for first, second in pairwise(watch.ticks)]
    gripped = next(i for i, tick in enumerate(watch.ticks) if tick.holding["right"])
    assert max(jumps[gripped - 1 : gripped + 20]) < 2e-4  # [rad/s]; a hand that rests is averaged meanwhile


def test_a_run_after_one_that_ended_while_something_was_held_bears_no_weight_that_is_not_there() -> None:
    config = object_cell({"mass": 2.0})
    loop = Pipeline.from_config(config, input=ScriptedInput("circle"), plant="mujoco", mode="torque")
    drive: Any = loop.drive
    drive.set_holding({"left": True})
    drive.reset(loop.plant.state())
    home, model = loop.robot.home, loop.robot.model
    bare = pin.computeGeneralizedGravity(model, model.createData(), home)
    assert np.abs(drive.impedance.gravity(home) - bare).max() > 1.0
    loop.run(0.01, realtime=False)
    np.testing.assert_allclose(drive.impedance.gravity(home), bare, atol=1e-9)


class LeftUpperPresses(ScriptedInput):
    """The left hand presses its upper button at 1.0 and at 1.6 s, and moves in between."""

    def poll(self, now: float) -> list[HandSample]:
        held = 1.0 <= now < 1.1 or 1.6 <= now < 1.7
        return [
            replace(sample, inputs=replace(sample.inputs, button_upper=held)) if sample.hand == "left" else sample
            for sample in super().poll(now)
        ]


def test_a_gripper_that_something_keeps_from_closing_holds_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(GripperLimiter, "limit", lambda *_: {"left": 0.5, "right": 1.0})
    loop = Pipeline.from_config(object_cell({}), input=LeftUpperPresses("circle"), plant="mujoco")
    watch = Watch(loop)
    loop.run(1.55, realtime=False)
    assert watch.ticks[-1].targets["left"].gripper == 0.0
    assert loop.plant.gripper_openings()["left"] == pytest.approx(0.5, abs=0.05)
    assert not any(tick.holding["left"] for tick in watch.ticks)


def test_a_gripper_closes_and_opens_with_the_upper_button_of_its_hand() -> None:
    loop = Pipeline.from_config(cell(), input=LeftUpperPresses("line"), plant="mujoco")
    watch = Watch(loop)
    summary = loop.run(2.2, realtime=False)
    assert {arm: figures.gripper_changes for arm, figures in summary.arms.items()} == {"left": 2, "right": 0}
    openings = {t: watch.ticks[round(t * 1000)].grippers for t in (0.95, 1.55, 2.15)}
    assert openings[0.95]["left"] > 0.95
    assert openings[1.55]["left"] < 0.05
    assert openings[2.15]["left"] > 0.95
    assert all(opening["right"] > 0.95 for opening in openings.values())


@pytest.mark.parametrize("mode", ["position", "torque"])
def test_two_simulated_runs_are_equal_bit_for_bit_also_on_the_same_pipeline(mode: str) -> None:
    def run(loop: Pipeline) -> tuple[list[bytes], RunSummary]:
        watch = Watch(loop)
        loop.input = ScriptedInput("circle", human=True, seed=1)
        summary = loop.run(1.5, realtime=False)
        loop.listeners.clear()
        bits = [b"".join((x.reference.q.tobytes(), x.reference.v.tobytes(), x.state.q.tobytes())) for x in watch.ticks]
        return bits, summary

    loop = pipeline(plant="mujoco", mode=mode)
    (first, one), (again, two), (third, _) = run(loop), run(loop), run(pipeline(plant="mujoco", mode=mode))
    assert first == again == third
    assert one.events == two.events
    assert [without_times(one), without_times(two)] == [without_times(one)] * 2


def without_times(summary: RunSummary) -> str:
    """A summary as JSON without the figures that depend on the machine's speed."""
    data = summary.as_json()
    del data["tick_us"], data["loop_rate_hz"]
    return json.dumps(data)


def test_a_run_starts_paused_even_when_the_one_before_ended_engaged() -> None:
    loop = pipeline()
    assert loop.run(2.0, realtime=False).arms["left"].engaged_s > 1.0
    for realtime in (False, True):
        loop.input = ScriptedInput("circle")
        watch = Watch(loop)
        summary = loop.run(0.3, realtime=realtime)
        assert not summary.events
        assert max(map(speed, watch.ticks)) < 1e-6
        loop.listeners.clear()


def test_runs_by_the_clock_keep_the_solver_s_time_limit_and_simulated_ones_have_none() -> None:
    loop = pipeline()
    assert loop.config.control.solve_time_limit is not None
    for realtime, expected in ((False, None), (True, loop.config.control.solve_time_limit), (False, None)):
        loop.run(0.05, realtime=realtime)
        assert loop.controller.settings.solve_time_limit == expected


@pytest.mark.parametrize(("mode", "may_touch"), [("position", 0), ("velocity", 0), ("torque", 1)])
def test_pairs_may_touch_in_torque_mode_only(mode: str, may_touch: int) -> None:
    contact = (ContactPair(pair=("*_finger_*", "table")),)
    config = cell()
    config = config.model_copy(update={"control": config.control.model_copy(update={"contact_allowed": contact})})
    running = Pipeline.from_config(config, plant="mujoco", mode=mode)
    assert len(running.controller.settings.contact_allowed) == may_touch
    running.run(0.05, realtime=False)
    assert len(running.controller.settings.contact_allowed) == may_touch


@pytest.mark.parametrize("rate", [50.0, 333.0, 1000.0])
def test_a_run_takes_as_many_ticks_as_its_duration_has_periods(rate: float) -> None:
    summary = pipeline(loop_rate_hz=rate).run(0.4, realtime=False)
    assert summary.ticks == round(0.4 * rate) + 1, "and one to come to rest"
    assert summary.duration_s == pytest.approx(summary.ticks / rate)


@pytest.mark.parametrize("rate", [50.0, 200.0])
def test_a_slow_loop_keeps_the_limits_too(rate: float) -> None:
    loop = pipeline(plant="mujoco", loop_rate_hz=rate)
    watch = Watch(loop)
    summary = loop.run(3.0, realtime=False)
    error = summary.arms["left"].position_error_mm_rms
    assert error is not None
    assert error < 15.0
    assert len(watch.ticks) == summary.ticks


def test_by_the_clock_a_run_lasts_as_long_as_it_is_asked_to() -> None:
    loop = pipeline(loop_rate_hz=100.0)
    watch = Watch(loop)
    summary = loop.run(0.5)
    times = np.array([tick.t for tick in watch.ticks])
    assert times[-1] >= 0.49
    assert summary.duration_s == pytest.approx(times[-1])
    assert summary.input_to_command_ms.p50 is not None


@pytest.mark.parametrize("duration", [0.0, -1.0, float("nan"), float("inf")])
def test_a_duration_that_is_no_time_is_refused(duration: float) -> None:
    with pytest.raises(ConfigError, match="allowed: a positive number of seconds"):
        pipeline().run(duration, realtime=False)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"input": "mouse"}, "input 'mouse': allowed are scripted, headset"),
        ({"plant": "gazebo"}, "plant 'gazebo': allowed are mujoco, kinematic"),
        ({"mode": "jerk"}, "mode jerk: MujocoPlant follows position, velocity, torque commands only"),
        (
            {"plant": "kinematic", "mode": "torque"},
            "mode torque: KinematicPlant follows position, velocity commands only",
        ),
    ],
)
def test_an_unknown_input_or_plant_and_a_mode_that_the_plant_does_not_have_are_refused(
    arguments: dict[str, str], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        Pipeline.from_config(cell(), **arguments)


def test_one_arm_alone_is_a_cell() -> None:
    config = cell().model_copy(update={"arms": {"left": cell().arms["left"]}, "obstacles": {}})
    loop = Pipeline.from_config(config, input=ScriptedInput("circle"), plant="kinematic")
    Watch(loop)
    summary = loop.run(2.0, realtime=False)
    assert list(summary.arms) == ["left"]
    assert summary.arms["left"].engaged_s > 1.0


class TestStop:
    @pytest.mark.parametrize("how", ["stop", "SIGINT", "SIGTERM"])
    def test_in_mid_motion_brakes_first(self, how: str) -> None:
        loop = pipeline()
        handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
        watch = Watch(loop)
        action = loop.stop if how == "stop" else lambda: os.kill(os.getpid(), getattr(signal, how))
        loop.listeners.append(when_moving(action))
        summary = loop.run(60.0, realtime=False)
        assert summary.duration_s < 5.0
        assert_braked(loop, watch, summary)
        assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == handlers

    def test_from_another_thread_in_mid_motion_brakes_first(self) -> None:
        loop = pipeline()
        watch = Watch(loop)
        moving = threading.Event()
        loop.listeners.append(when_moving(moving.set))
        summaries: list[RunSummary] = []
        thread = threading.Thread(target=lambda: summaries.append(loop.run()))
        thread.start()
        assert moving.wait(30.0)
        loop.stop()
        thread.join(10.0)
        assert not thread.is_alive()
        assert_braked(loop, watch, summaries[0])

    def test_at_the_end_of_the_duration_brakes_first(self) -> None:
        loop = pipeline()
        watch = Watch(loop)
        assert_braked(loop, watch, loop.run(2.5, realtime=False))

    def test_in_torque_mode_the_arms_come_to_rest_at_the_reference_and_do_not_drop_afterwards(self) -> None:
        loop = pipeline(plant="mujoco", mode="torque")
        watch = Watch(loop)
        loop.listeners.append(when_moving(loop.stop))
        summary = loop.run(60.0, realtime=False)
        assert_braked(loop, watch, summary)
        assert_torque_bounds(loop, watch.ticks)
        rest = loop.plant.state()
        assert np.abs(rest.v).max() < 1e-2
        np.testing.assert_allclose(rest.q, watch.ticks[-1].reference.q, atol=5e-3)
        for tick, after in pairwise(watch.ticks):
            for arm in SIDES:
                due = loop.robot.tool_pose(tick.reference.q, arm).translation
                assert np.linalg.norm(after.tools[arm].translation - due) < 3e-3
        for _ in range(20):
            loop.plant.advance(0.1)
            np.testing.assert_allclose(loop.plant.state().q, rest.q, atol=1e-3)

    def test_waits_for_slow_braking(self) -> None:
        # Braking takes longer than the second that is allowed for in addition.
        control = cell().control.model_copy(update={"acceleration_limit": 0.05})
        loop = pipeline(control=control)
        watch = Watch(loop)
        summary = loop.run(4.0, realtime=False)
        before = next(tick for tick in watch.ticks if STOPPING in tick.states.values())
        assert speed(before) > 0.05, "a stop of more than a second"
        assert speed(watch.ticks[-1]) < 1e-3
        assert summary.at_rest

    def test_asked_for_before_the_run_ends_it_at_once_and_the_next_one_runs(self) -> None:
        loop = pipeline()
        loop.stop()
        assert loop.run(10.0, realtime=False).ticks == 1
        assert loop.run(0.1, realtime=False).ticks > 50

    @pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
    def test_of_a_process_by_a_signal_returns_its_summary(self, name: str) -> None:
        script = (
            "import json\n"
            "from tests.test_pipeline import Watch, pipeline, when_moving\n"
            "loop = pipeline(plant='mujoco')\n"
            "watch = Watch(loop)\n"
            "loop.listeners.append(when_moving(lambda: print('moving', flush=True)))\n"
            "print(json.dumps(loop.run(10.0).as_json()), flush=True)\n"
        )
        for _ in range(10):
            with subprocess.Popen(
                [sys.executable, "-c", script], cwd=CHECKOUT, stdout=subprocess.PIPE, text=True
            ) as run:
                assert run.stdout is not None
                if run.stdout.readline() != "moving\n":
                    continue  # other load on the machine has paused the arms before they moved
                run.send_signal(getattr(signal, name))
                summary = json.loads(run.stdout.readline())
                assert run.wait(60.0) == 0
                break
        assert summary["at_rest"]
        assert summary["max_velocity_ratio"] > 0.0
        assert summary["max_acceleration_ratio"] <= 1.0 + 1e-9


def assert_braked(loop: Pipeline, watch: Watch, summary: RunSummary) -> None:
    """The run ended at rest, without input from the stop on; the contract was checked at every tick."""
    stopping = [tick for tick in watch.ticks if STOPPING in tick.states.values()]
    assert stopping[0] is watch.ticks[-len(stopping)]
    assert all(not tick.samples and not any(tick.engaged.values()) for tick in stopping)
    assert speed(watch.ticks[-len(stopping) - 1]) > 0.05, "it was moving"
    assert speed(watch.ticks[-1]) < 1e-3
    assert summary.at_rest
    limit = loop.robot.capped_acceleration(loop.config.control.acceleration_limit)
    braking = float((np.abs(watch.ticks[-len(stopping) - 1].reference.v) / limit).max())
    # Slower motion than that is the last correction of a posture that is held.
    rest = next(tick for tick in stopping if speed(tick) < 1e-3)
    assert rest.t - stopping[0].t <= 1.5 * braking + 0.05 + 3.0 * max(tick.dt for tick in stopping)
    assert not loop.stopping


class TestFailure:
    def test_of_a_listener_brakes_first_and_calls_it_no_more(self) -> None:
        loop, calls = pipeline(), []

        def fail() -> None:
            calls.append(1)
            raise RuntimeError("the listener failed")

        loop.listeners.append(when_moving(fail))
        watch = Watch(loop)
        with pytest.raises(RuntimeError, match="the listener failed"):
            loop.run(60.0, realtime=False)
        assert len(calls) == 1
        assert speed(watch.ticks[-1]) <= 1e-6 < max(map(speed, watch.ticks))

    @pytest.mark.parametrize("call", ["poll", "connected"])
    def test_of_the_input_brakes_first(self, call: str, monkeypatch: pytest.MonkeyPatch) -> None:
        loop = pipeline()
        watch = Watch(loop)

        def fail(*_: object) -> None:
            raise RuntimeError("the input failed")

        broken = property(fail) if call == "connected" else fail
        loop.listeners.append(when_moving(lambda: monkeypatch.setattr(ScriptedInput, call, broken)))
        with pytest.raises(RuntimeError, match="the input failed"):
            loop.run(60.0, realtime=False)
        assert speed(watch.ticks[-1]) <= 1e-6 < max(map(speed, watch.ticks))

    @pytest.mark.parametrize("who", ["plant", "listener", "reset", "nobody"])
    def test_leaves_no_thread_no_port_and_no_plant_behind(self, who: str, monkeypatch: pytest.MonkeyPatch) -> None:
        plant, server = RecordingPlant(), HeadsetServer(port=0)
        loop = Pipeline.from_config(cell(), input=server, plant=plant)

        def fail(*_: object) -> None:
            raise RuntimeError(f"the {who} failed")

        if who == "plant":
            plant.fails_at = 20
        elif who == "listener":
            loop.listeners.append(fail)
        elif who == "reset":
            monkeypatch.setattr(plant, "reset", fail)
        if who == "nobody":
            loop.run(0.1, realtime=False)
        else:
            with pytest.raises(RuntimeError, match=f"the {who} failed"):
                loop.run(1.0, realtime=False)
        assert plant.closed == 1
        assert "headset" not in {thread.name for thread in threading.enumerate()}
        with socket.create_server(server.address):
            pass
        assert gc.isenabled()
        assert gc.get_freeze_count() == 0

    def test_to_open_the_input_closes_the_plant_and_names_the_port(self) -> None:
        plant = RecordingPlant()
        with socket.create_server(("127.0.0.1", 0)) as taken:
            loop = Pipeline.from_config(cell(), input=HeadsetServer(port=taken.getsockname()[1]), plant=plant)
            with pytest.raises(InputError, match=str(taken.getsockname()[1])):
                loop.run(1.0, realtime=False)
        assert plant.closed == 1
        assert not plant.commands


class HostileInput:
    """A hand that moves normally and presses buttons, with invalid samples in between."""

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self._source = ScriptedInput("circle", human=True, seed=seed, frequency_hz=1.0)
        self.connected = True
        self.start, self.close, self.send_haptic = self._source.start, self._source.close, self._source.send_haptic

    def poll(self, now: float) -> list[HandSample]:
        random = self._random
        self.connected = bool(random.random() > 1e-3)
        pressed = now % 0.6 < 0.2
        samples = [
            replace(sample, inputs=replace(sample.inputs, button_lower=pressed)) for sample in self._source.poll(now)
        ]
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


def test_ten_thousand_ticks_of_hostile_samples_break_no_limit_and_raise_nothing() -> None:
    loop = Pipeline.from_config(cell(), input=HostileInput(7), plant="kinematic")
    watch = Watch(loop)
    summary = loop.run(10.0, realtime=False)
    assert summary.ticks == len(watch.ticks) >= 10_000
    json.dumps(summary.as_json(), allow_nan=False)
    assert summary.at_rest
    assert len(watch.engagements("left")) >= 5, "valid samples are followed"
    assert max(map(speed, watch.ticks)) > 0.3
    reasons = " ".join(event.reason for event in summary.events)
    for fault in ("not finite", "jumped", "connection lost", "alignment chord"):
        assert fault in reasons
    for arm in SIDES:
        for index in watch.engagements(arm):
            tick = watch.ticks[index]
            pose = tick.targets[arm].pose
            assert pose is not None
            assert np.linalg.norm(pose.translation - tick.tools[arm].translation) < 1e-6
