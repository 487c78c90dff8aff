"""Each kind of action in a dataset repeats the recorded motion, if the actions are sent at their times."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.export.sampling import features, sample
from q2r2_control.inputs.policy import ActionSpace, PolicyInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.recording.reader import Recording
from q2r2_control.summary.tick import Tick
from q2r2_control.types import Array
from tests.recording.runs import file_of, pipeline, record

pytestmark = pytest.mark.slow

FPS = 30
DURATION = 5.0  # [s]
CHUNK = 16  # Number of actions in a chunk. The next chunk replaces half of them.


def tools_of(loop: Pipeline) -> list[dict[str, pin.SE3]]:
    """Return a list that gets the measured tool poses of each tick of the next run."""
    tools: list[dict[str, pin.SE3]] = []
    loop.listeners.append(lambda tick: tools.append(tick.tools))
    return tools


class Playback:
    """A policy that sends the actions of a dataset in chunks. A chunk begins with the action that is due."""

    def __init__(self, policy: PolicyInput, actions: Array) -> None:
        self._policy, self._actions, self._next = policy, actions, 0

    def __call__(self, tick: Tick) -> None:
        begin, frame = tick.start.now + tick.dt, self._next  # The first frame belongs to the first tick.
        if tick.now >= begin + frame / FPS - 1e-9 and frame < len(self._actions):
            chunk = self._actions[frame : frame + CHUNK]
            self._policy.send(chunk, begin + np.arange(frame, frame + len(chunk)) / FPS)
            self._next += CHUNK // 2


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[dict[str, pin.SE3]], dict[str, Array]]:
    """Return the tool poses of a run in MuJoCo, and the vectors of its dataset. The tools come together and turn."""
    loop = pipeline("meet", "mujoco")
    tools = tools_of(loop)
    file = file_of(record(tmp_path_factory.mktemp("recordings"), loop, DURATION))
    vectors, _ = features(sample(Recording(file), FPS), loop.robot)
    return tools, {name: values.astype(np.float64) for name, values in vectors.items()}


@pytest.mark.parametrize("space", ActionSpace)
def test_the_actions_of_a_dataset_repeat_the_recorded_motion_when_sent_at_their_times(
    recorded: tuple[list[dict[str, pin.SE3]], dict[str, Array]], space: ActionSpace
) -> None:
    before, vectors = recorded
    policy = PolicyInput(space=space)
    loop = pipeline(source=policy, plant="mujoco")
    tools = tools_of(loop)
    loop.listeners.append(Playback(policy, vectors[space]))
    summary = loop.run(DURATION, realtime=False)
    for arm in loop.robot.arms:
        ways = [there[arm].actInv(here[arm]) for there, here in zip(before, tools, strict=False)]
        apart = np.array([(np.linalg.norm(way.translation), np.linalg.norm(pin.log3(way.rotation))) for way in ways])
        distance, angle = np.sqrt(np.mean(apart**2, axis=0))
        assert max(np.linalg.norm(here[arm].translation - before[0][arm].translation) for here in before) > 0.1
        assert distance < 0.5e-3
        assert np.degrees(angle) < 0.2
        assert summary.arms[arm].policy_s > DURATION - 0.1
