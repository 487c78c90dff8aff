"""A run ends by a request or a failure. Before its end, the arms come to rest, and all resources are released."""

from __future__ import annotations

import os
import signal
import socket
import threading
from itertools import pairwise

import numpy as np
import pytest

from q2r2_control.errors import InputError
from q2r2_control.inputs.headset import HeadsetServer
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.pipeline.pipeline import STOPPING, Pipeline
from q2r2_control.summary.run_summary import RunSummary
from q2r2_control.types import SIDES
from tests.pipeline.loops import RecordingPlant, pipeline, when_moving
from tests.support.processes import Watch, assert_torque_bounds, cell, speed


@pytest.mark.slow
class TestStop:
    @pytest.mark.parametrize("how", ["the duration", "SIGINT", "SIGTERM"])
    def test_a_run_that_is_ended_during_motion_first_brakes_the_arms(self, how: str) -> None:
        loop = pipeline()
        handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
        watch = Watch(loop)
        if how != "the duration":
            loop.listeners.append(when_moving(lambda: os.kill(os.getpid(), getattr(signal, how))))
        summary = loop.run(2.5 if how == "the duration" else 60.0, realtime=False)
        assert summary.duration_s < 5.0
        assert_braked(loop, watch, summary)
        assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == handlers

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

    def test_a_run_ends_only_when_slow_braking_has_ended(self) -> None:
        # Braking takes longer than a second. A run waits for the braking time and for one second more.
        loop = pipeline(control=cell().control.model_copy(update={"acceleration_limit": 0.05}))
        watch = Watch(loop)
        summary = loop.run(4.0, realtime=False)
        before = next(tick for tick in watch.ticks if STOPPING in tick.states.values())
        assert speed(before) > 0.05, "a stop of more than a second"
        assert speed(watch.ticks[-1]) < 1e-3
        assert summary.at_rest

    def test_a_run_that_a_program_stops_before_its_start_ends_at_once_and_the_next_run_is_not_affected(self) -> None:
        loop = pipeline()
        loop.stop()
        assert loop.run(10.0, realtime=False).ticks == 1
        assert loop.run(0.1, realtime=False).ticks > 50


def assert_braked(loop: Pipeline, watch: Watch, summary: RunSummary) -> None:
    """Assert that the arms braked to rest in time before the run ended, and got no input while they braked."""
    stopping = [tick for tick in watch.ticks if STOPPING in tick.states.values()]
    assert stopping[0] is watch.ticks[-len(stopping)]
    assert all(not tick.samples and not any(tick.engaged.values()) for tick in stopping)
    assert speed(watch.ticks[-len(stopping) - 1]) > 0.05, "it was moving"
    assert speed(watch.ticks[-1]) < 1e-3
    assert summary.at_rest
    limit = loop.robot.capped_acceleration(loop.config.control.acceleration_limit)
    braking = float((np.abs(watch.ticks[-len(stopping) - 1].reference.v) / limit).max())
    # A joint below 1e-3 rad/s counts as resting, because it only corrects the held posture.
    rest = next(tick for tick in stopping if speed(tick) < 1e-3)
    assert rest.t - stopping[0].t <= 1.5 * braking + 0.05 + 3.0 * max(tick.dt for tick in stopping)


@pytest.mark.slow
class TestFailure:
    def test_if_a_listener_fails_the_arms_brake_first_and_the_listener_is_not_called_again(self) -> None:
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
    def test_if_an_input_fails_the_arms_brake_before_the_run_ends(
        self, call: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        loop = pipeline()
        watch = Watch(loop)

        def fail(*_: object) -> None:
            raise RuntimeError("the input failed")

        broken = property(fail) if call == "connected" else fail
        loop.listeners.append(when_moving(lambda: monkeypatch.setattr(ScriptedInput, call, broken)))
        with pytest.raises(RuntimeError, match="the input failed"):
            loop.run(60.0, realtime=False)
        assert speed(watch.ticks[-1]) <= 1e-6 < max(map(speed, watch.ticks))

    @pytest.mark.parametrize("who", ["apply", "listener", "reset", "nobody"])
    def test_after_a_run_its_thread_has_ended_and_its_port_and_its_plant_are_closed(
        self, who: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        plant, server = RecordingPlant(), HeadsetServer(port=0)
        loop = Pipeline.from_config(cell(), input=server, plant=plant)

        def fail(*_: object) -> None:
            raise RuntimeError(f"the {who} failed")

        if who == "listener":
            loop.listeners.append(fail)
        elif who in ("apply", "reset"):
            monkeypatch.setattr(plant, who, fail)
        if who == "nobody":
            loop.run(0.1, realtime=False)
        else:
            with pytest.raises(RuntimeError, match=f"the {who} failed"):
                loop.run(1.0, realtime=False)
        assert plant.closed == 1
        assert "headset" not in {thread.name for thread in threading.enumerate()}
        with socket.create_server(server.address):
            pass

    def test_an_input_that_cannot_open_closes_the_plant_and_names_the_port(self) -> None:
        plant = RecordingPlant()
        with socket.create_server(("127.0.0.1", 0)) as taken:
            loop = Pipeline.from_config(cell(), input=HeadsetServer(port=taken.getsockname()[1]), plant=plant)
            with pytest.raises(InputError, match=str(taken.getsockname()[1])):
                loop.run(1.0, realtime=False)
        assert plant.closed == 1
        assert not plant.commands
