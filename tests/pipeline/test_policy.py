"""A policy in the loop: its limits, takeovers by an operator, and the recording of both."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.export.sampling import features, sample
from q2r2_control.inputs.policy import ActionSpace, PolicyInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.recording.reader import Recording
from q2r2_control.recording.replay import replay
from q2r2_control.summary.tick import Tick
from q2r2_control.types import SIDES, Array, HandInputs, HandSample, Observation
from tests.recording.runs import file_of, pipeline, record
from tests.support.hands_input import HandsInput
from tests.support.processes import Watch, changes

pytestmark = pytest.mark.slow

# Length of a cycle, length of a press, and time in the cycle at which the operator gives the arms back [s].
# The operator takes over at the start of each cycle.
CYCLE, PRESS, GIVES_BACK = 0.6, 0.1, 0.3


class Circle:
    """A policy that moves both tools in circles of 60 mm, which begin at the first tool poses that it sees."""

    space, rate = ActionSpace.TOOL, 50.0

    def __init__(self) -> None:
        self.start: Observation | None = None

    def __call__(self, observation: Observation) -> Array:
        self.start = self.start or observation
        phase = 2.0 * (observation.time - self.start.time + np.arange(10) / self.rate)
        poses = np.array([[pin.SE3ToXYZQUAT(tool) for tool in self.start.tools.values()]] * len(phase))
        poses[:, :, 1] += 0.03 * np.sin(phase)[:, None]
        poses[:, :, 2] += 0.03 * (1.0 - np.cos(phase))[:, None]
        return poses.reshape(len(phase), -1)


class Operator(HandsInput):
    """An operator who presses the lower buttons to take the arms over, and again to give them back to the policy.

    The hands always move.
    """

    def poll(self, now: float) -> list[HandSample]:
        hand = super().poll(now)
        since = now % CYCLE
        pressed = now > CYCLE and (since < PRESS or GIVES_BACK <= since < GIVES_BACK + PRESS)
        inputs = HandInputs(button_lower=pressed)
        place = np.array([0.02 * np.sin(5.0 * now), 0.0, 0.0])
        return [HandSample(one.hand, place, one.quaternion, now, inputs, now) for one in hand]


def with_operator() -> Pipeline:
    return pipeline(source=PolicyInput(Circle(), operator=Operator()))


def test_no_target_jumps_at_a_takeover_and_every_tick_says_who_acted() -> None:
    loop, count = with_operator(), 8
    watch = Watch(loop)
    summary = loop.run((count + 1) * CYCLE, realtime=False)
    for arm in SIDES:
        states = [tick.states[arm] for tick in watch.ticks]
        changes = [(k, *pair) for k, pair in enumerate(pairwise(states), 1) if len(set(pair)) > 1]
        taken = [k for k, before, now in changes if (before, now) == ("policy", "engaged")]
        given = [k for k, _, now in changes if now == "policy"]
        assert (len(taken), len(given)) == (count, count + 1)
        for k in taken:
            before, after = (watch.ticks[i].targets[arm].command for i in (k - 1, k))
            assert before is not None
            assert after is not None
            assert np.linalg.norm(after.translation - before.translation) <= 1e-6
            assert np.linalg.norm(pin.log3(before.rotation.T @ after.rotation)) <= 1e-6
        for k in given[1:]:
            target, tool = (
                watch.ticks[k].targets[arm].command,
                loop.robot.tool_pose(watch.ticks[k - 1].reference.q, arm),
            )
            assert target is not None
            assert np.linalg.norm(target.translation - tool.translation) <= 1e-6
        engaged = [state == "engaged" for state in states]
        assert [tick.interventions[arm] for tick in watch.ticks] == engaged
        assert summary.arms[arm].interventions == count
        assert summary.arms[arm].intervention_s == pytest.approx(sum(engaged) * 0.002)
        assert summary.arms[arm].policy_s == pytest.approx(states.count("policy") * 0.002)


def test_a_recording_says_at_every_frame_who_acted_and_its_replay_is_equal_to_the_bit(tmp_path: Path) -> None:
    loop, tags = with_operator(), []
    loop.listeners.append(lambda tick: tags.append([tick.interventions[arm] for arm in SIDES]))
    file = file_of(record(tmp_path, loop, 3.0 * CYCLE))
    vectors, names = features(sample(Recording(file), 500), loop.robot)
    assert names["intervention"] == SIDES
    assert 0.0 < vectors["intervention"].mean() < 1.0
    np.testing.assert_array_equal(vectors["intervention"], tags)
    again = replay(file)
    assert (again.difference, again.ended_by) == (None, None)


class Jumping(Circle):
    """A policy whose actions jump: from 0.3 s on, they put the left tool 1 m away from its path."""

    def __call__(self, observation: Observation) -> Array:
        actions = super().__call__(observation)
        assert self.start is not None
        if observation.time - self.start.time > 0.3:
            actions[:, 0] += 1.0
        return actions


def test_no_arm_moves_on_alone_after_a_fault_of_the_policy() -> None:
    loop = pipeline(source=PolicyInput(Jumping()))
    watch = Watch(loop)
    loop.run(1.2, realtime=False)
    states = [tuple(tick.states.values()) for tick in watch.ticks]
    assert ("policy", "policy") in states
    first = states.index(("lost", "lost"))
    assert set(states[first:]) <= {("lost", "lost"), ("stopping", "stopping")}


class Leaving(HandsInput):
    """Hands that fall silent after a while."""

    def poll(self, now: float) -> list[HandSample]:
        return super().poll(now) if now < 0.9 else []


@pytest.mark.parametrize("stopped", [False, True], ids=["engaged", "after a stop that waits for a press"])
def test_after_a_program_has_given_the_arms_to_the_policy_the_arms_move_without_a_press(stopped: bool) -> None:
    policy = PolicyInput(Circle(), operator=Leaving())
    loop = pipeline(source=policy)
    watch = Watch(loop)

    def ask(tick: Tick) -> None:
        if stopped and len(watch.ticks) == 300:
            loop.pause()
        if len(watch.ticks) == 500:
            loop.give_back()
        if len(watch.ticks) == 600:
            policy.send([np.nan] * 14)

    loop.listeners.append(ask)
    summary = loop.run(1.5, realtime=False)
    given = [("engaged", "paused", "policy_requested")]
    if stopped:
        given = [("engaged", "lost", "pause_requested"), ("lost", "paused", "policy_requested")]
    fault, begins = ("policy", "lost", "policy_unusable"), ("policy", "policy_acts")
    for arm in SIDES:
        found = [change for change in changes(list(summary.events), arm) if change[0] != change[1]]
        place = found.index(given[0])
        wanted = [*given, ("paused", *begins), fault, ("lost", *begins)]
        assert found[place : place + len(wanted)] == wanted


def colliding(loop: Pipeline) -> Array:
    """Return joint positions at which both arms, turned towards each other, penetrate each other."""
    q = loop.robot.home.copy()
    while loop.robot.distance_values(q).min() > -0.03:
        q[[0, 7]] += (-0.05, 0.05)
    return q


def touching(plant: MujocoPlant) -> set[str]:
    """Return the bodies of the arms that touch anything now."""
    bodies = {plant.model.geom_bodyid[geom] for pair in plant.data.contact.geom.tolist() for geom in pair}
    return {name for body in bodies if (name := plant.model.body(body).name).startswith(SIDES)}


def test_if_a_policy_would_make_the_arms_collide_nothing_touches_and_the_summary_names_the_pair() -> None:
    policy, touched = PolicyInput(), set[str]()
    loop = pipeline(source=policy, plant="mujoco")
    plant, home, goal = loop.plant, loop.robot.home, colliding(loop)
    assert isinstance(plant, MujocoPlant)

    def drive(tick: Tick) -> None:
        if len(watch.ticks) % 50 == 0:
            times = tick.now + np.arange(10) / 20.0
            shares = np.minimum((times - tick.start.now) / 3.0, 1.0)[:, None]
            policy.send(home + shares * (goal - home), times)
        touched.update(touching(plant))

    watch = Watch(loop)
    loop.listeners.append(drive)
    summary = loop.run(4.0, realtime=False)
    assert touched == set()
    assert {name.split("_")[0] for name in summary.closest_pair or ()} == set(SIDES)
    assert summary.min_distance_mm == pytest.approx(20.0, abs=3.0)
    assert summary.at_rest
    assert max(np.linalg.norm(tick.reference.q - home) for tick in watch.ticks) > 0.2
    plant.reset(goal)
    assert touching(plant)
