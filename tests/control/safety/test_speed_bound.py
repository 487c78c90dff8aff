from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.control.geometry.kinematics import IntArray
from q2r2_control.control.jit import kernel
from q2r2_control.control.safety.safety_data import SafetyData, SafetyModel
from q2r2_control.control.safety.speed_bound import BodyVelocities, fastest_approach, least_distance, write_deviations
from q2r2_control.control.safety.stop_certificate import write_step
from q2r2_control.control.safety.stop_rollout import OWN, SHAPES, TOGETHER, begin_rollout
from q2r2_control.types import Array
from tests.control.cells import NAMES, cell, distances, kernel_model, placed, random_posture, reused_data
from tests.control.safety.motions import ACCELERATION, H, Motion, motion_of


def prepared(name: str, motion: Motion) -> tuple[SafetyData, float]:
    """Return the data that the certificate has before it examines pairs, and the time h + T / 2 [s].

    The step takes h, and the stop takes T.
    """
    model, data = kernel_model(name).safety, reused_data(name, motion.q, motion.v).safety
    data.distance[:] = distances(cell(name), motion.q[None])[0]
    data.candidate.q[:] = motion.q_next
    data.candidate.v[:] = motion.v_next
    data.candidate.deceleration[:] = motion.deceleration
    duration = begin_rollout(data)
    write_step(data, H)
    return data, write_deviations(model, data, H, duration)


def bounds_of(name: str, motion: Motion) -> Array:
    """Return a lower bound on the distance of each pair (p,) in the motion, from the speeds of its bodies [m]."""
    data, time = prepared(name, motion)
    bounds = np.zeros_like(data.distance)
    _least_distances(kernel_model(name).safety, data, time, bounds)
    return bounds


@kernel
def _least_distances(model: SafetyModel, data: SafetyData, time: float, out: Array) -> None:
    """Compute the bounds for all pairs in one call, because each call from Python passes all arrays again."""
    for p in range(out.shape[0]):
        out[p] = least_distance(model, data, p, time)


def least_along(name: str, motion: Motion) -> Array:
    return np.asarray(distances(cell(name), np.concatenate([motion.step(), motion.stop()])).min(axis=0))


def share_no_joint(name: str) -> Array:
    return cell(name).pairs.carried == 0


def test_velocities_of_bodies_are_the_rates_of_change_of_their_positions() -> None:
    random, robot = np.random.default_rng(60), cell("dual_panda").robot
    q, v = random_posture(robot, random), random.uniform(-1.0, 1.0, robot.model.nv)
    later, earlier = (placed(cell("dual_panda"), q + share * v).posed for share in (1e-6, -1e-6))
    moved = 0.5 * (later.start + later.end - earlier.start - earlier.end)
    np.testing.assert_allclose(reused_data("dual_panda", q, v).safety.velocities.middle, moved / 2e-6, atol=1e-8)


@pytest.mark.parametrize("shape", range(SHAPES), ids=["together", "arm by arm", "own"])
@pytest.mark.parametrize("name", NAMES)
def test_no_pair_comes_closer_in_a_step_and_in_any_kind_of_stop_than_its_speed_bound_says(
    name: str, shape: int
) -> None:
    random, robot = np.random.default_rng(61), cell(name).robot
    apart = share_no_joint(name)
    for _ in range(40):
        v = random.choice([0.02, 0.3, 1.0]) * random.uniform(-robot.velocity_limit, robot.velocity_limit)
        v_next = v + random.uniform(-1, 1, 14) * ACCELERATION * H
        motion = motion_of(name, random_posture(robot, random), v, v_next, shape)
        assert (bounds_of(name, motion) <= least_along(name, motion) + 1e-12)[apart].all()


def still_hand(q: Array, random: np.random.Generator) -> Array:
    """Return velocities (14,) [rad/s] that turn the left elbow while the left hand is at rest. The right arm rests."""
    robot = cell("dual_iiwa7").robot
    data = robot.model.createData()
    pin.computeJointJacobians(robot.model, data, q)
    J = pin.getJointJacobian(robot.model, data, robot.model.getJointId("left_A7"), pin.WORLD)[:, :7]
    return np.concatenate([np.linalg.svd(J)[2][-1] * random.choice([-1.0, 1.0]), np.zeros(7)])


@pytest.mark.parametrize(
    ("shape", "speed"), [(TOGETHER, 2.0), (OWN, 0.2)], ids=["the ways are curved", "joints rest one after the other"]
)
def test_the_bound_holds_if_a_hand_rests_at_first_while_its_arm_moves_and_then_moves_while_the_arm_stops(
    shape: int, speed: float
) -> None:
    random, robot = np.random.default_rng(62), cell("dual_iiwa7").robot
    apart, moved = share_no_joint("dual_iiwa7"), 0
    for _ in range(40):
        q = random_posture(robot, random)
        v = speed * still_hand(q, random)
        motion = motion_of("dual_iiwa7", q, v, v, shape)
        bounds, least = bounds_of("dual_iiwa7", motion), least_along("dual_iiwa7", motion)
        assert (bounds <= least + 1e-12)[apart].all()
        moved += int((least < distances(cell("dual_iiwa7"), q[None])[0] - 1e-6)[apart].sum())
    assert moved > 100


@pytest.mark.parametrize("speed", [0.01, 0.1], ids=["a stop as short as the step", "a long stop"])
def test_the_speed_bound_holds_and_is_tight_if_all_joints_stop_together(speed: float) -> None:
    random, robot = np.random.default_rng(64), cell("dual_iiwa7").robot
    apart, used = share_no_joint("dual_iiwa7"), []
    for _ in range(40):
        v = speed * random.uniform(-robot.velocity_limit, robot.velocity_limit)
        motion = motion_of("dual_iiwa7", random_posture(robot, random), v, v, TOGETHER)
        now = distances(cell("dual_iiwa7"), motion.q[None])[0]
        closer, bound = now - least_along("dual_iiwa7", motion), now - bounds_of("dual_iiwa7", motion)
        assert (closer <= bound + 1e-12)[apart].all()
        used.append((closer / bound)[apart].max())
    assert np.median(used) > 0.6  # A smaller median would show that the bound is too weak to be useful.


@pytest.mark.parametrize("shape", [TOGETHER, OWN])
def test_the_deviation_of_a_joint_includes_the_motions_of_the_joints_between_the_base_and_this_joint(
    shape: int,
) -> None:
    random, robot = np.random.default_rng(65), cell("dual_iiwa7").robot
    v, dv = random.uniform(-1, 1, 14), random.uniform(-1, 1, 14) * ACCELERATION * H
    motion = motion_of("dual_iiwa7", random_posture(robot, random), v, v + dv, shape)
    braking = np.abs(motion.v_next) / motion.deceleration
    last = braking.max()
    stop = 0.5 * np.abs(motion.v_next) * braking
    ways = np.abs(np.diff(motion.step(), axis=0)).sum(axis=0) + stop
    rho = 0.5 * np.abs(dv) * (H + last) + 0.5 * np.abs(motion.v_next) * last - stop
    carriers = [[i - 1 for i in robot.model.supports[j + 1] if 0 < i <= j] for j in range(14)]
    kappa = ways * (0.5 * ways + np.array([ways[before].sum() for before in carriers]))
    data, time = prepared("dual_iiwa7", motion)
    assert time == pytest.approx(H + 0.5 * last)
    assert data.rollout.deviation == pytest.approx(rho + kappa, rel=1e-3)
    assert kappa.max() > 0.01 * rho.max()


@pytest.mark.parametrize("name", NAMES)
def test_the_array_carried_marks_exactly_the_pairs_whose_bodies_share_a_moving_joint(name: str) -> None:
    model, pairs, bodies = cell(name).robot.model, cell(name).pairs, cell(name).bodies
    movers = [set(model.supports[int(joint)]) - {0} for joint in bodies.joint]
    together = [bool(movers[first] & movers[second]) for first, second in zip(pairs.first, pairs.second, strict=True)]
    assert (pairs.carried == together).all()
    assert any(together)
    assert not all(together)


STEP = 1e-6  # Step of finite differences [s].


def bounds_at(name: str, q: Array, v: Array) -> Array:
    """Return the bound on the approach speed of every pair (p,) [m/s]."""
    model, data = kernel_model(name).safety.collision, reused_data(name, q, v).safety
    bounds = np.zeros(len(model.pairs.first))
    _fastest_approaches(data.velocities, model.pairs.first, model.pairs.second, bounds)
    return bounds


@kernel
def _fastest_approaches(velocities: BodyVelocities, first: IntArray, second: IntArray, out: Array) -> None:
    for p in range(out.shape[0]):
        out[p] = fastest_approach(velocities, first[p], second[p])


@pytest.mark.parametrize("name", NAMES)
def test_no_pair_approaches_faster_than_its_bound_and_some_pairs_approach_nearly_that_fast(name: str) -> None:
    random, robot = np.random.default_rng(51), cell(name).robot
    nearest = 0.0
    for _ in range(30):
        q, v = random_posture(robot, random), random.uniform(-robot.velocity_limit, robot.velocity_limit)
        before, after = distances(cell(name), np.array([q - STEP * v, q + STEP * v]))
        closing, bounds = (before - after) / (2 * STEP), bounds_at(name, q, v)
        apart = np.minimum(before, after) > 0.0
        assert (closing[apart] <= bounds[apart] + 1e-6).all()
        nearest = max(nearest, float((closing[apart] / np.maximum(bounds[apart], 0.1)).max()))
    assert nearest > 0.7
