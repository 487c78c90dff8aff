"""The policy input checks each action, and tells each fault in one line."""

from __future__ import annotations

import json
import sys
import threading
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.errors import ConfigError
from q2r2_control.inputs.base import PolicySource
from q2r2_control.inputs.policy import ActionSpace, PolicyInput
from q2r2_control.robot.robot import Robot
from q2r2_control.types import SIDES, ActionChunk, Array, Observation, RobotState
from q2r2_control.wording import sentence
from tests.support.processes import cell, wait_until


@cache
def robot() -> Robot:
    return Robot.from_config(cell())


def opened(space: ActionSpace = ActionSpace.JOINTS, **more: Any) -> PolicyInput:
    policy = PolicyInput(space=space, **more)
    policy.prepare(robot(), more.get("policy") is None)
    return policy


def observed(time: float = 1.0) -> Observation:
    home = robot().home
    return Observation(time, RobotState(home, 0.0 * home, 0.0 * home, None, time), {}, {})


def sent(policy: PolicyInput, *arguments: Any) -> ActionChunk:
    policy.send(*arguments)
    (chunk,) = policy.chunks()
    return chunk


def test_the_policy_input_implements_the_interface_of_a_policy_source() -> None:
    assert isinstance(opened(), PolicySource)


def test_joint_positions_of_an_action_become_tool_poses_and_a_posture() -> None:
    q = robot().home + 0.1
    chunk = sent(opened(), [[*q, 0.3, 2.0]], [5.0])
    assert chunk.fault is None
    assert chunk.postures is not None
    np.testing.assert_array_equal(chunk.postures[0], q)
    for arm in robot().arms:
        np.testing.assert_allclose(chunk.tools[arm][0], pin.SE3ToXYZQUAT(robot().tool_pose(q, arm)), atol=1e-12)
    assert [chunk.grippers[arm][0] for arm in robot().arms] == [0.3, 1.0]


def test_a_chunk_of_actions_is_exactly_the_same_after_it_was_written_as_json_and_read() -> None:
    chunk = sent(opened(), np.tile(robot().home / 3.0, (3, 1)), [0.1, 0.2, 0.3])
    again = ActionChunk.from_json(json.loads(json.dumps(chunk.as_json())))
    assert again.as_json() == chunk.as_json()
    assert again.postures is not None
    assert chunk.postures is not None
    assert again.postures.tobytes() == chunk.postures.tobytes()


JOINTS = tuple(f"{arm}_A{number}" for arm in SIDES for number in range(1, 8))
ZEROS = np.zeros((2, 14))


def with_one(value: float) -> Array:
    actions = ZEROS.copy()
    actions[1, 3] = value
    return actions


@pytest.mark.parametrize(
    ("actions", "times", "names", "told"),
    [
        (with_one(np.nan), [0.0, 0.1], (), "action 1: left_A4 = nan; allowed: finite numbers"),
        (with_one(np.inf), [0.0, 0.1], (), "action 1: left_A4 = inf"),
        (ZEROS[:, :13], [0.0, 0.1], (), "number 13 is missing; allowed: right_A7"),
        (np.zeros((2, 17)), [0.0, 0.1], (), "actions have the shape (2, 17); allowed: (n, 14 or 16)"),
        (np.zeros((2, 2, 14)), [0.0, 0.1], (), "actions have the shape (2, 2, 14)"),
        (np.zeros((0, 14)), [], (), "0 actions in one answer; allowed: 1 to 1000"),
        (np.zeros((1001, 14)), None, (), "1001 actions in one answer; allowed: 1 to 1000"),
        (None, [0.0], (), "actions are None; allowed: an array of numbers"),
        ("left", [0.0], (), "actions = 'left'; allowed: an array of numbers"),
        (ZEROS, [0.1, 0.0], (), "times = [0.1, 0.0]; allowed: ascending"),
        (ZEROS, [0.0], (), "allowed: a finite number for each of 2 actions"),
        (ZEROS, None, (), "times are missing, and nothing was observed yet"),
        (ZEROS, [0.0, 0.1], (*JOINTS[7:], *JOINTS[:7]), "number 0 is 'right_A1'; allowed: left_A1, in the order"),
        (np.zeros((2, 16)), [0.0, 0.1], (*JOINTS, "right_gripper", "left_gripper"), "names end with"),
    ],
)
def test_the_fault_of_unusable_actions_is_named_in_one_line(
    actions: Any, times: Any, names: tuple[str, ...], told: str
) -> None:
    chunk = sent(opened(), actions, times, names)
    assert chunk.fault is not None
    text = sentence(chunk.fault)
    assert told in text
    assert "\n" not in text


def test_the_fault_of_an_action_names_a_quaternion_that_is_not_a_rotation() -> None:
    poses = np.tile([0.5, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0], (1, 2))
    poses[0, 13] = 0.0
    chunk = sent(opened(ActionSpace.TOOL), poses, [0.0])
    assert chunk.fault is not None
    assert "action 0: the quaternion of right has the length 0" in sentence(chunk.fault)


def test_a_policy_runs_on_its_own_thread_and_is_called_again_when_half_of_its_actions_are_over() -> None:
    threads: list[str] = []
    chunks: list[ActionChunk] = []

    def hold(observation: Observation) -> Array:
        threads.append(threading.current_thread().name)
        return np.tile(observation.state.q, (10, 1))

    def received(count: int) -> bool:
        chunks.extend(policy.chunks())
        return len(chunks) == count

    policy = PolicyInput(hold, rate=10.0)
    policy.prepare(robot(), realtime=True)
    policy.start()
    try:
        for time, asked in ((1.0, 1), (1.4, 1), (1.5, 2)):
            policy.observe(observed(time))
            wait_until(partial(received, asked))
        assert set(threads) == {"policy"}
        assert [chunk.times[0] for chunk in chunks] == [1.0, 1.5]
    finally:
        policy.close()


def asked(policy: PolicyInput, time: float = 1.0) -> str:
    """Call the policy with an observation, and return the sentence about the fault of its actions."""
    policy.observe(observed(time))
    (chunk,) = policy.chunks()
    assert chunk.fault is not None
    return sentence(chunk.fault)


def of_function(function: Any) -> PolicyInput:
    policy = PolicyInput(function)
    policy.prepare(robot(), realtime=False)
    return policy


def test_an_exception_of_a_policy_is_a_fault_of_its_actions() -> None:
    def fails(observation: Observation) -> Array:
        raise RuntimeError("no weights\nwere found")

    assert asked(of_function(fails)).endswith("the policy raised RuntimeError: no weights were found")


def test_the_traceback_of_a_policy_is_logged_once_for_each_error(caplog: pytest.LogCaptureFixture) -> None:
    def fails(observation: Observation) -> Array:
        if observation.time > 2.5:
            raise ValueError("another error")
        raise RuntimeError("no weights were found")

    policy = of_function(fails)
    for time in (1.0, 2.0, 3.0, 4.0):
        asked(policy, time)
    first, second = (record.getMessage() for record in caplog.records)
    assert 'raise RuntimeError("no weights were found")' in first
    assert 'raise ValueError("another error")' in second
    assert "_ask" not in first, "the traceback begins in the policy"


def test_if_a_policy_returns_none_the_fault_of_its_actions_says_so() -> None:
    told = asked(of_function(lambda seen: None))
    assert told.endswith("the policy returned None; allowed: an array of actions (n, size)")


@pytest.mark.parametrize("error", [SystemExit(3), GeneratorExit()], ids=repr)
def test_if_a_policy_raises_systemexit_or_generatorexit_this_is_a_fault_and_the_policy_is_called_again(
    error: BaseException,
) -> None:
    def leaves(observation: Observation) -> Array:
        raise error

    policy = PolicyInput(leaves)
    policy.prepare(robot(), realtime=True)
    chunks: list[ActionChunk] = []

    def received(count: int) -> bool:
        chunks.extend(policy.chunks())
        return len(chunks) == count

    policy.start()
    try:
        for count in (1, 2):
            policy.observe(observed(float(count)))
            wait_until(partial(received, count))
        faults = [chunk.fault for chunk in chunks]
        assert all(fault and f"the policy raised {type(error).__name__}" in sentence(fault) for fault in faults)
    finally:
        policy.close()


def test_a_signal_that_ends_the_program_is_not_a_fault_of_the_policy() -> None:
    def interrupted(observation: Observation) -> Array:
        raise SystemExit

    with pytest.raises(SystemExit):
        asked(of_function(interrupted))


def test_a_policy_is_found_by_its_name_in_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_policy.py").write_text(
        "class Still:\n    rate = 20.0\n    def __call__(self, seen): return seen.state.q\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert PolicyInput.from_config(cell(), policy="my_policy:Still").period == 0.05
    for wrong in ("my_policy:Moving", "nowhere:Still", "my_policy"):
        with pytest.raises(ConfigError, match=f"--policy {wrong}"):
            PolicyInput.from_config(cell(), policy=wrong)
    with pytest.raises(ConfigError, match="--policy MODULE:NAME is missing"):
        PolicyInput.from_config(cell())


@pytest.mark.parametrize("more", [{"space": "joints"}, {"rate": 0.0}, {"rate": 1000.0}], ids=str)
def test_a_wrong_action_space_or_rate_raises_an_error_with_what_is_allowed(more: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="allowed: "):
        PolicyInput(**more)
