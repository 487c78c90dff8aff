"""Tasks as environments: a seed makes them repeatable, the motion of the demo solves them, and all promises hold."""

from __future__ import annotations

import itertools
import os
import re
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pinocchio as pin
import pytest

pytest.importorskip("gymnasium", reason="the extra gym is not installed")

import gymnasium
from gymnasium.utils.env_checker import check_env

from q2r2_control import gym
from q2r2_control.demo.assembly_tasks import TASKS
from q2r2_control.errors import ConfigError
from q2r2_control.gym.task_env import TaskEnv
from q2r2_control.inputs.assembly import WORKS
from q2r2_control.inputs.policy import ActionSpace
from q2r2_control.inputs.way_points import HOME, WayPoints
from q2r2_control.pipeline.operator_side import OperatorSide
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.summary.run_summary import RunStatistics
from q2r2_control.types import SIDES
from tests.demo.test_assembly_tasks import coarse
from tests.support.pictures import needs_opengl

ROOT = Path(__file__).resolve().parents[2]
RATE = 30.0


def make(task: str = "grasp", **options: Any) -> TaskEnv:
    return TaskEnv(task, cell=coarse(), rate=RATE, **options)


@cache
def shared() -> TaskEnv:
    return make(space=ActionSpace.JOINTS)


def test_every_task_is_registered_and_an_episode_is_long_enough_for_its_work() -> None:
    assert set(gym.TASKS) == set(TASKS)
    for task in gym.TASKS:
        spec = gymnasium.spec(f"q2r2/{task.capitalize()}-v0")
        assert spec.kwargs == {"task": task}
        assert spec.max_episode_steps is not None
        assert spec.max_episode_steps >= RATE * WORKS[task].duration


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("space", list(ActionSpace))
def test_the_checks_of_gymnasium_pass(space: ActionSpace) -> None:
    check_env(make(space=space), skip_render_check=True)


def script(task: str, env: TaskEnv, step: int) -> npt.NDArray[np.float32]:
    """Return the action (tool poses and openings) with which a step does the same as the demo's hands."""
    work, t, poses, openings = WORKS[task], step / RATE, [], []
    for arm in SIDES:
        points = work.tools.get(arm, ((1.0, *HOME[arm], 0.0, 0.0),))
        place, turn = WayPoints(((0.0, *HOME[arm], 0.0, 0.0), *points)).at(t)
        down = pin.exp3(np.pi * np.eye(3)[1])
        poses.append(pin.SE3ToXYZQUAT(pin.SE3(pin.exp3(turn) @ down, place)))
        openings.append(float(sum(press <= t for press in work.presses.get(arm, ())) % 2 == 0))
    return np.hstack((*poses, openings)).astype(np.float32)


@pytest.mark.slow
def test_the_motion_of_the_demo_earns_the_reward_and_keeps_every_promise() -> None:
    env = make("grasp", space="action.tool", spread=0.0)
    env.reset(seed=0)
    rewards, held = [], set()
    for step in range(int(RATE * WORKS["grasp"].duration) + 30):
        _, reward, terminated, _, info = env.step(script("grasp", env, step))
        rewards.append(reward)
        held.add(info["promises"]["held_back"])
        assert info["promises"]["certified"]
        assert info["promises"]["margin"] >= 0.0
        assert info["promises"]["nearest_distance"] > 0.0
        if terminated:
            break
    assert rewards[-1] == 1.0
    assert sum(rewards) == 1.0
    assert info["is_success"]
    assert info["measured"]["held_s"] >= 1.0


def test_a_seed_places_the_parts_and_equal_actions_then_have_equal_results() -> None:
    env, seen = shared(), []
    for seed in (3, 3, 4):
        env.reset(seed=seed)
        place = env._plant.data.body("flat_block").xpos.copy()
        action = env.reset(seed=seed)[0]["observation.state"]
        action[0] += 0.01
        for _ in range(5):
            observed, *_ = env.step(action)
        seen.append((place, observed["observation.state"]))
    np.testing.assert_array_equal(seen[0][0], seen[1][0])
    np.testing.assert_array_equal(seen[0][1], seen[1][1])
    assert 0.0 < np.abs(seen[0][0] - seen[2][0]).max() <= 0.02


def test_random_actions_of_an_untrained_agent_move_the_tools() -> None:
    env = make()
    env.reset(seed=0)
    env.action_space.seed(0)
    tools, held = [], set()
    for _ in range(10):
        observed, _, _, _, info = env.step(env.action_space.sample())
        tools.append(observed["observation.tool"])
        held.add(info["promises"]["held_back"])
    assert np.abs(tools[-1] - tools[0]).max() > 0.01
    assert not any("jump" in said for said in held)


def test_the_arms_follow_small_actions_and_the_environment_says_why_it_refuses_large_actions() -> None:
    env = shared()
    start = env.reset(seed=0)[0]["observation.state"]
    action = start.copy()
    action[0] += 0.02
    for _ in range(30):
        observed, *_, info = env.step(action)
    assert observed["observation.state"][0] == pytest.approx(action[0], abs=2e-3)
    assert info["promises"]["held_back"] == ""
    rested = observed["observation.state"]
    for _ in range(10):
        observed, _, terminated, _, info = env.step(env.action_space.high)
    assert not terminated
    assert "allowed: 0.1 m and 0.5 rad" in info["promises"]["held_back"]
    np.testing.assert_allclose(observed["observation.state"], rested, atol=0.02)
    action[0] = np.nan
    *_, info = env.step(action)
    assert "nan" in info["promises"]["held_back"]


def test_a_slower_loop_needs_fewer_ticks_for_the_same_steps_and_keeps_the_promises(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ticks, tools, tick, taken = [], [], Pipeline.tick, itertools.count()
    monkeypatch.setattr(Pipeline, "tick", lambda self: (next(taken), tick(self))[1])
    for rate in (1000.0, 100.0):
        env = TaskEnv("grasp", rate=RATE, loop_rate=rate, spread=0.0)
        env.reset(seed=0)
        before = next(taken)
        move = env.action_space.low * 0.1
        for _ in range(10):
            observed, *_, info = env.step(move)
            assert info["promises"]["certified"]
            assert info["promises"]["margin"] >= 0.0
        ticks.append(next(taken) - before - 1)
        tools.append(observed["observation.tool"])
    assert ticks == [333, 33]
    # The tools lag behind their targets by some ticks, so their positions in the two loops differ.
    np.testing.assert_allclose(tools[0], tools[1], atol=0.02)
    with pytest.raises(ConfigError, match=r"loop_rate = 20: allowed: 50 to 1000 Hz"):
        TaskEnv("grasp", loop_rate=20)


def test_a_step_computes_no_summary_and_vibrates_no_device(monkeypatch: pytest.MonkeyPatch) -> None:
    env = shared()
    env.reset(seed=0)
    for owner, name in ((RunStatistics, "add"), (OperatorSide, "_inspect")):
        monkeypatch.setattr(owner, name, lambda *_: pytest.fail("nobody asks for this"))
    action = env.reset(seed=0)[0]["observation.state"]
    for _ in range(3):
        env.step(action)


def time_of(env: TaskEnv) -> float:
    observation = env._policy.observation
    assert observation is not None
    return observation.time


def test_each_step_ends_at_the_time_of_the_next_frame_of_a_dataset_with_the_same_rate() -> None:
    env = shared()
    still = env.reset(seed=0)[0]["observation.state"]
    start = time_of(env)
    for step in range(1, 40):
        env.step(still)
        assert 0.0 <= start + step / RATE - time_of(env) + 1e-9 < 1.0 / coarse().nominal_rate_hz


@pytest.mark.slow
def test_the_example_of_docs_policies_runs_unchanged(capsys: pytest.CaptureFixture[str]) -> None:
    found = re.search(r"```python\n(import gymnasium.*?)```", (ROOT / "docs/policies.md").read_text(), re.DOTALL)
    assert found is not None
    exec(found[1], {})
    assert "yellow_block on blue_block on green_block for the last 0.0 s" in capsys.readouterr().out


@pytest.mark.slow
def test_two_environments_run_in_their_own_processes() -> None:
    envs = gym.make_env(n_envs=2, use_async_envs=True, cfg=object(), task="handover", cell=coarse())
    try:
        observed, infos = envs.reset(seed=[1, 2])
        assert observed["observation.state"].shape == (2, 16)
        observed, rewards, *_, infos = envs.step(observed["observation.state"])
        assert rewards.tolist() == [0.0, 0.0]
        assert (infos["promises"]["nearest_distance"] > 0.02).all()
    finally:
        envs.close()


@pytest.mark.slow
def test_pictures_are_observed_and_rendered_without_a_window() -> None:
    needs_opengl()
    code = (
        "import gymnasium\n"
        "env = gymnasium.make('q2r2_control.gym:q2r2/Stack-v0', pictures=True, render_mode='rgb_array')\n"
        "seen, _ = env.reset(seed=0)\n"
        "assert env.observation_space.contains(seen)\n"
        "print((seen['observation.images.above'] == env.render()).all(), env.render().std() > 10)\n"
    )
    environment = {"MUJOCO_GL": "egl", **os.environ}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert run.stdout.split() == ["True", "True"], run.stderr
