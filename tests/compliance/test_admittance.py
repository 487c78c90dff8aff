"""Compliance in position mode: the displacement of targets, the estimate of the wrench, and both in a closed loop."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.compliance.admittance import Admittance, estimate_wrench, oscillate
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.control import AdmittanceSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.control.tasks.frame import ROTATION_LENGTH
from q2r2_control.errors import ConfigError
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.types import Array, Command, CommandMode, RobotState
from q2r2_control.verification.contract import Contract
from tests.control.cells import cell, random_posture

ROBOT = cell("dual_iiwa7").robot
REST = np.zeros(len(ROBOT.home))
GOALS: dict[str, pin.SE3 | None] = {arm: ROBOT.tool_pose(ROBOT.home, arm) for arm in ROBOT.arms}
DEFAULT = AdmittanceSettings()
DT = 0.001


def _wrench(axis: int, size: float) -> Array:
    return size * np.eye(6)[axis]


def _state(q: Array, tau: Array | None) -> RobotState:
    return RobotState(q, REST, REST, tau, 0.0)


def _jacobian(q: Array, arm: str = "left") -> Array:
    """Return the Jacobian (6, 7) of the arm's joints."""
    found, data = ROBOT.arms[arm], ROBOT.model.createData()
    J = pin.computeFrameJacobian(ROBOT.model, data, q, found.frame_id, pin.LOCAL_WORLD_ALIGNED)
    return np.array(J[:, found.joints])


def _touch(wrench: Array, arm: str = "left") -> RobotState:
    """Return a state in which ``wrench`` acts on the arm's tool."""
    tau = REST.copy()
    tau[ROBOT.arms[arm].joints] = _jacobian(ROBOT.home, arm).T @ wrench
    return _state(ROBOT.home, tau)


UNTOUCHED = _state(ROBOT.home, REST)


def _away(pose: pin.SE3 | None, goal: pin.SE3 | None) -> Array:
    """Return translation and rotation vector (6,) from ``goal`` to ``pose``, in world axes."""
    assert pose is not None
    assert goal is not None
    return np.concatenate([pose.translation - goal.translation, pin.log3(pose.rotation @ goal.rotation.T)])


def _displaced(admittance: Admittance, state: RobotState, ticks: int, dt: float = DT) -> list[Array]:
    """Return the displacement (6,) of the left target [m], [rad] at each of the next ``ticks``."""
    return [_away(admittance.update(GOALS, state, dt)["left"], GOALS["left"]) for _ in range(ticks)]


def _stiffness(axis: int) -> float:
    return DEFAULT.stiffness if axis < 3 else DEFAULT.rotation_stiffness


def _ratio(x: Array) -> float:
    """Return the damping ratio from the first two extremes of a decaying oscillation that starts at rest."""
    first = int(np.argmin(x * np.sign(x[0])))
    second = first + int(np.argmax(x[first:] * np.sign(x[0])))
    logarithm = float(np.log(abs(x[first]) / abs(x[second])))
    return logarithm / float(np.hypot(np.pi, logarithm))


AXES = pytest.mark.parametrize("axis", [0, 2, 4], ids=["along x", "along z", "about y"])


@pytest.mark.slow
@pytest.mark.parametrize(("axis", "ratio", "dt"), [(0, 0.2, 0.001), (5, 0.6, 0.01)], ids=["moved", "turned"])
def test_after_a_push_the_target_returns_with_the_damping_ratio_of_the_settings(
    axis: int, ratio: float, dt: float
) -> None:
    admittance = Admittance(ROBOT, AdmittanceSettings(damping_ratio=ratio))
    _displaced(admittance, _touch(_wrench(axis, 20.0 if axis < 3 else 5.0)), round(4.0 / dt), dt)
    back = np.array(_displaced(admittance, UNTOUCHED, round(1.5 / dt), dt))[:, axis]
    assert _ratio(back) == pytest.approx(ratio, abs=0.05)


@pytest.mark.slow
def test_with_critical_damping_the_target_returns_exactly_and_does_not_overshoot() -> None:
    admittance = Admittance(ROBOT)
    _displaced(admittance, _touch(_wrench(2, -20.0)), 2000)
    back = np.array(_displaced(admittance, UNTOUCHED, 4000))[:, 2]
    # After the release, the filtered wrench decays and is soon below the dead band.
    assert (np.diff(back) >= 0.0).all()
    assert back[0] < -0.019
    assert admittance.update(GOALS, UNTOUCHED, DT)["left"] is GOALS["left"]


@AXES
def test_a_force_below_the_dead_band_never_moves_the_tool(axis: int) -> None:
    admittance, band = Admittance(ROBOT), DEFAULT.force_dead_band if axis < 3 else DEFAULT.torque_dead_band
    state = _touch(_wrench(axis, 0.99 * band))
    for _ in range(500):
        assert admittance.update(GOALS, state, 0.01) == GOALS
    assert not admittance.report().arms["left"].displacement.any()
    assert admittance.report().arms["left"].wrench[axis] == pytest.approx(0.99 * band)


@pytest.mark.slow
def test_beyond_the_dead_band_the_displacement_grows_gradually_to_the_force_divided_by_the_stiffness() -> None:
    forces = np.linspace(1.5, 30.0, 115)
    ends = np.array([_displaced(Admittance(ROBOT), _touch(_wrench(0, force)), 100, 0.1)[-1][0] for force in forces])
    slopes = np.diff(ends) / np.diff(forces)
    assert (slopes >= 0.0).all()
    assert slopes.max() <= 2.0 / DEFAULT.stiffness
    lost = forces - DEFAULT.stiffness * ends
    assert lost[forces >= 14.0].max() < 0.02 * 14.0 + 0.02


@pytest.mark.slow
def test_any_wrench_at_any_tick_keeps_the_displacement_inside_its_limits() -> None:
    random, admittance = np.random.default_rng(53), Admittance(ROBOT, AdmittanceSettings(damping_ratio=0.1))
    farthest = np.zeros(2)
    for _ in range(3000):
        push = random.normal(0.0, 1.0, 6) * 10.0 ** random.uniform(0.0, 4.0)
        dt = float(10.0 ** random.uniform(-6.0, -1.0))
        x = _displaced(admittance, _touch(push), 1, dt)[0]
        assert np.isfinite(x).all()
        size = np.array([np.linalg.norm(x[:3]), np.linalg.norm(x[3:])])
        assert size[0] <= DEFAULT.max_displacement + 1e-12
        assert size[1] <= DEFAULT.max_rotation + 1e-9
        farthest = np.maximum(farthest, size)
    np.testing.assert_allclose(farthest, [DEFAULT.max_displacement, DEFAULT.max_rotation], rtol=1e-6)


def test_the_velocity_of_the_displacement_becomes_zero_when_the_displacement_is_at_its_limit() -> None:
    admittance = Admittance(ROBOT, AdmittanceSettings(damping_ratio=0.1, filter_time=0.0))
    push, x = _touch(_wrench(0, 95.0)), 0.0
    while x < DEFAULT.max_displacement - 1e-9:
        x = _displaced(admittance, push, 1)[0][0]
    back = np.array(_displaced(admittance, UNTOUCHED, 50))[:, 0]
    assert (np.diff([x, *back]) < 0.0).all()


def test_an_arm_yields_only_to_a_push_at_its_own_tool() -> None:
    admittance = Admittance(ROBOT)
    for _ in range(500):
        targets = admittance.update(GOALS, _touch(_wrench(2, 20.0), "right"), DT)
    assert targets["left"] is GOALS["left"]
    assert _away(targets["right"], GOALS["right"])[2] > 0.01


def test_an_arm_without_a_target_is_not_displaced_and_later_starts_from_its_new_target() -> None:
    admittance, push = Admittance(ROBOT), _touch(_wrench(0, 20.0))
    assert _displaced(admittance, push, 1000)[-1][0] > 0.015
    for holding in ({"left": None, "right": GOALS["right"]}, {"right": GOALS["right"]}):
        assert admittance.update(holding, push, DT) == holding
        assert not admittance.report().arms["left"].displacement.any()
        assert admittance.report().arms["left"].wrench[0] == pytest.approx(20.0, rel=1e-3)
    # The push continues, so the displacement starts from rest with the acceleration of the virtual mass.
    first = _displaced(admittance, push, 1)[0]
    assert 0.0 < first[0] <= 0.5 * 20.0 / DEFAULT.mass * DT**2 * 1.001


def test_if_torques_are_no_longer_measured_the_target_returns_without_a_jump() -> None:
    admittance = Admittance(ROBOT)
    pushed = _displaced(admittance, _touch(_wrench(0, 20.0)), 1000)
    after = _displaced(admittance, _state(ROBOT.home, None), 2000)
    assert np.abs(np.diff([pushed[-1], *after], axis=0)).max() < 2e-4
    assert np.abs(after[-1]).max() < 1e-6
    assert not admittance.report().rejected


BAD = {
    "torque": (np.where(np.arange(14) == 3, np.nan, 0.0), ROBOT.home),
    "infinite torque": (np.where(np.arange(14) == 9, np.inf, 0.0), ROBOT.home),
    "posture": (REST, np.where(np.arange(14) == 3, np.nan, ROBOT.home)),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", BAD)
def test_if_a_measurement_is_not_finite_the_last_wrench_is_kept_and_the_fault_is_reported(kind: str) -> None:
    admittance, (tau, q) = Admittance(ROBOT), BAD[kind]
    _displaced(admittance, _touch(_wrench(1, 20.0)), 3000)
    before = admittance.report().arms["left"]
    for x in _displaced(admittance, _state(q, tau), 200):
        np.testing.assert_allclose(x, before.displacement, atol=1e-6)
        assert admittance.report().rejected
        np.testing.assert_array_equal(admittance.report().arms["left"].wrench, before.wrench)
    _displaced(admittance, UNTOUCHED, 1)
    assert not admittance.report().rejected


@pytest.mark.parametrize("dt", [0.0, np.nan])
def test_an_invalid_dt_changes_no_displacement_and_is_reported(dt: float) -> None:
    admittance, push = Admittance(ROBOT), _touch(_wrench(1, 20.0))
    before = _displaced(admittance, push, 100)[-1]
    np.testing.assert_array_equal(_displaced(admittance, push, 1, dt)[0], before)
    assert admittance.report().rejected


def test_a_reset_sets_the_wrench_and_the_displacement_to_zero() -> None:
    admittance = Admittance(ROBOT)
    _displaced(admittance, _touch(_wrench(0, 20.0)), 500)
    admittance.reset()
    assert admittance.update(GOALS, UNTOUCHED, DT) == GOALS
    assert not admittance.report().arms["left"].wrench.any()


@pytest.mark.parametrize("key", ["stiffness", "rotation_stiffness", "damping_ratio", "mass", "inertia"])
def test_settings_with_which_an_arm_would_drift_or_gain_energy_are_refused(key: str) -> None:
    with pytest.raises(ConfigError, match=key):
        AdmittanceSettings(**{key: 0.0})


SOFT = 4000.0  # Stiffness of the servos [Nm/rad].


@cache
def _plant() -> MujocoPlant:
    config = load_config("config/dual_iiwa7.yaml")
    servos = config.mujoco.model_copy(update={"position_stiffness": SOFT, "objects": {}})
    return MujocoPlant(ROBOT, config.model_copy(update={"mujoco": servos}))


def _loop(goals: dict[str, pin.SE3 | None], dt: float, ticks: int) -> Iterator[Array]:
    """Run the closed loop, and check the contract at every tick.

    Yield at every tick the displacement (6,) [m], [rad] from the goal to the left tool pose of the reference.
    """
    controller, admittance, plant = CartesianController(ROBOT), Admittance(ROBOT), _plant()
    plant.reset()
    contract = Contract(controller, ROBOT.home)
    for _ in range(ticks):
        reference = controller.step(admittance.update(goals, plant.state(), dt), dt)
        contract.check(reference, dt)
        plant.apply(Command(CommandMode.POSITION, reference.q, reference.v, REST, {}))
        plant.advance(dt)
        yield _away(controller.tool_pose("left"), goals["left"])


@pytest.mark.slow
@AXES
def test_a_push_in_mujoco_moves_the_tool_by_the_sum_of_the_displacements_of_admittance_and_servos(
    axis: int,
) -> None:
    push = _wrench(axis, 20.0 if axis < 3 else 5.0)
    for tick, x in enumerate(_loop(GOALS, 0.002, 1500)):
        if tick == 50:
            np.testing.assert_allclose(x, 0.0, atol=1e-6)  # The tool does not drift before the push.
            _plant().push("left", push, 1.95)
        if tick == 1000:
            expected = push[axis] / _stiffness(axis)
            assert x[axis] == pytest.approx(expected, rel=0.05)
            np.testing.assert_allclose(np.delete(x, axis), 0.0, atol=0.05 * expected)
            J = _jacobian(ROBOT.home)
            give = J @ J.T @ push / SOFT
            measured = _away(ROBOT.tool_pose(_plant().state().q, "left"), GOALS["left"])
            assert measured[axis] == pytest.approx(expected + give[axis], rel=0.05)
    np.testing.assert_allclose(x, 0.0, atol=1e-4)


@pytest.mark.slow
def test_a_tool_that_presses_on_a_body_with_a_stiffness_of_10_kilonewtons_per_metre_comes_to_rest() -> None:
    body = 10000.0
    surface = ROBOT.tool_pose(ROBOT.home, "left").translation[2] - 0.02
    below = {arm: pin.SE3(goal.rotation, goal.translation - [0.0, 0.0, 0.06]) for arm, goal in GOALS.items() if goal}
    forces = []
    for _ in _loop(dict(below), DT, 2500):
        height = ROBOT.tool_pose(_plant().state().q, "left").translation[2]
        forces.append(max(0.0, body * (surface - height)))
        _plant().push("left", _wrench(2, forces[-1]), DT)
    settled = np.array(forces[-500:])
    assert np.ptp(settled) < 0.1
    in_series = 0.04 / (1 / DEFAULT.stiffness + 1 / body)
    assert settled[-1] == pytest.approx(in_series, rel=0.1)


SCALE = np.array([1.0, 1.0, 1.0, *[ROTATION_LENGTH] * 3])


def _least_singular(q: Array) -> float:
    return float(np.linalg.svd(SCALE[:, None] * _jacobian(q))[1][-1])


@pytest.fixture(scope="module")
def regular() -> list[Array]:
    random = np.random.default_rng(41)
    postures = [random_posture(ROBOT, random) for _ in range(200)]
    return [ROBOT.home, *(q for q in postures if _least_singular(q) > 0.05)]


def test_a_wrench_at_the_tool_is_estimated_exactly_in_every_posture_that_is_not_singular(regular: list[Array]) -> None:
    random = np.random.default_rng(42)
    assert len(regular) > 50
    for q in regular:
        wrench = random.normal(0.0, [20.0, 20.0, 20.0, 5.0, 5.0, 5.0])
        np.testing.assert_allclose(estimate_wrench(_jacobian(q), _jacobian(q).T @ wrench), wrench, atol=1e-8)


def test_for_torques_that_no_wrench_can_cause_the_estimate_is_the_least_squares_wrench(regular: list[Array]) -> None:
    random = np.random.default_rng(43)
    for q in regular:
        tau = random.normal(0.0, 10.0, 7)
        np.testing.assert_allclose(estimate_wrench(_jacobian(q), tau), np.linalg.pinv(_jacobian(q).T) @ tau, atol=1e-7)


def test_for_a_stretched_arm_the_estimate_is_bounded_and_has_no_force_along_the_arm() -> None:
    random, upright = np.random.default_rng(45), np.zeros(len(ROBOT.home))
    assert _least_singular(upright) < 1e-9
    along = np.array([0.0, 0.0, 30.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(estimate_wrench(_jacobian(upright), _jacobian(upright).T @ along), 0.0, atol=1e-9)
    for angle in np.linspace(0.0, 0.3, 60):
        bent = upright.copy()
        bent[3] = angle
        tau = random.uniform(-1.0, 1.0, 7)
        # A torque in the direction of the singular value s gives a wrench that is f(s) times as large. With e = 0.05,
        # f(s) = s / (s^2 + e^2 (1 - s^2/e^2)^2) <= 1.16 / e.
        assert np.linalg.norm(estimate_wrench(_jacobian(bent), tau) / SCALE) <= 1.16 / 0.05 * np.linalg.norm(tau)


@pytest.mark.parametrize("ratio", [0.1, 1.0 - 1e-9, 1.0, 1.3])
def test_one_step_of_the_oscillator_equals_a_thousand_small_steps(ratio: float) -> None:
    start, many = np.array([0.03]), np.array([0.03])
    x, v = oscillate(start, np.array([-0.2]), 12.0, ratio, 0.1)
    # The small steps use the derivatives from the differential equation.
    speed, h = np.array([-0.2]), 1e-4
    for _ in range(1000):
        acceleration = -2 * ratio * 12.0 * speed - 144.0 * many
        jerk = -2 * ratio * 12.0 * acceleration - 144.0 * speed
        many = many + h * speed + h**2 / 2 * acceleration
        speed = speed + h * acceleration + h**2 / 2 * jerk
    np.testing.assert_allclose((x, v), (many, speed), atol=1e-6)


def test_a_stiff_and_overdamped_oscillator_neither_overflows_nor_grows() -> None:
    x, v = oscillate(np.array([0.1]), np.array([1.0]), 200.0, 5.0, 0.1)
    assert 0.0 < x < 0.2
    assert abs(v) < 1.0
