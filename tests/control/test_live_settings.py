"""Distances and gains change while the arms move: the contract holds at every tick, and no motion jumps."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.config.control import LIVE, ControllerSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.control.live_settings import GROWTH, arrays_in
from q2r2_control.control.tasks.built_in import task_model_of
from q2r2_control.robot.kept_distances import kept_distances
from tests.control.cells import kernel_model
from tests.control.scenarios import SCENARIOS, circle
from tests.control.test_scenarios import robot_of
from tests.support.driven import Driven

DT = 0.002
NEAR, FAR = 0.005, 0.035  # A small and a great value of min_distance [m].
UP = np.array([0.0, 0.0, 0.05])  # [m]


@pytest.fixture
def controller() -> CartesianController:
    return CartesianController(robot_of("iiwa7"), ControllerSettings(min_distance=NEAR))


def margins(run: Driven) -> np.ndarray:
    """Return by how much the distance of every pair exceeds the requested distance (p,) [m]."""
    return run.robot.distance_values(run.q) - kept_distances(run.robot, run.controller.settings).values


@pytest.mark.slow
def test_a_greater_min_distance_pushes_no_pair_apart_and_is_kept_once_the_pair_has_opened(
    controller: CartesianController,
) -> None:
    run = Driven(controller)
    run.drive(4.0, SCENARIOS["crossing"])
    run.drive(0.5)
    assert margins(run).min() < 0.005
    before, pair = run.q, controller.robot.distance_values(run.q)
    assert controller.change({"min_distance": FAR}) is None
    run.drive(1.5)
    assert np.abs(run.q - before).max() < 1e-4
    assert margins(run).min() < -0.02  # The pair is nearer than requested, and is not pushed apart.
    assert len(controller.narrow_pair or ()) == 2
    assert controller.kept_distances.min() > 0.6 * pair.min()  # The pair keeps most of its present distance.
    run.drive(3.0, run.start)
    assert controller.narrow_pair is None
    assert controller.kept_distances.min() == FAR
    run.drive(3.0, SCENARIOS["crossing"])
    assert 0.0 <= margins(run).min() < 0.005
    assert run.contract.uncertified == 0


def test_a_kept_distance_grows_no_faster_than_allowed_and_falls_at_once(controller: CartesianController) -> None:
    run = Driven(controller)
    run.drive(0.1)
    assert controller.change({"min_distance": FAR}) is None
    seconds = 0.0
    while controller.narrow_pair is not None and seconds < 2.0:
        run.drive(0.01)
        seconds += 0.01
        assert controller.kept_distances.max() <= NEAR + GROWTH * (seconds + 0.011)
    assert seconds == pytest.approx((FAR - NEAR) / GROWTH, abs=0.05)
    assert controller.change({"min_distance": NEAR}) is None
    assert controller.kept_distances.max() == NEAR


@pytest.mark.slow
def test_random_changes_of_settings_during_motion_never_break_the_contract(controller: CartesianController) -> None:
    random, run = np.random.default_rng(3), Driven(controller)
    scenarios = [SCENARIOS[name] for name in ("crossing", "same point", "teleport", "into the table")] + [circle]
    for _ in range(30):
        name = str(random.choice(LIVE))
        drawn = random.choice([0.2, 0.9] if name.endswith("weight") else [0.2, 1.0, 2.9])
        value = random.uniform(0.0, FAR) if name == "min_distance" else drawn
        assert controller.change({name: float(value)}) is None
        run.drive(0.2, scenarios[random.integers(len(scenarios))])
    assert run.contract.uncertified == 0


def test_a_smaller_separation_gain_slows_approaching_arms_and_no_velocity_jumps(
    controller: CartesianController,
) -> None:
    closing, changes = {}, {}
    for gain in (10.0, 0.5):
        assert controller.change({"separation_gain": 10.0}) is None
        run = Driven(controller)
        run.drive(0.2, SCENARIOS["crossing"])
        room, before = margins(run).min(), run.v
        assert controller.change({"separation_gain": gain}) is None
        run.drive(DT, SCENARIOS["crossing"])
        changes[gain] = run.v - before
        run.drive(0.4, SCENARIOS["crossing"])
        closing[gain] = room - margins(run).min()
    assert closing[0.5] < 0.8 * closing[10.0]
    assert np.abs(changes[0.5] - changes[10.0]).max() < 3e-4


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in LIVE if name != "min_distance"])
def test_after_a_change_of_a_setting_a_controller_moves_exactly_like_a_controller_made_with_this_setting(
    name: str,
) -> None:
    """Both motions are equal to the bit.

    The arms first block each other, so the right arm gives way. Then both targets are out of reach.
    """
    usual = ControllerSettings(priority="left")
    value = 0.4 * getattr(usual, name)
    made = [CartesianController(robot_of("iiwa7"), usual.model_copy(update=update)) for update in ({name: value}, {})]
    ways = [_way(one) for one in made]
    assert made[1].change({name: value}) is None
    made[1].reset(made[1].robot.home)
    np.testing.assert_array_equal(_way(made[1]), ways[0])
    assert np.abs(ways[0] - ways[1]).max() > 1e-4


def test_every_setting_that_the_task_model_keeps_in_an_array_can_change_while_the_controller_runs() -> None:
    usual = ControllerSettings(priority="left")

    def arrays(settings: ControllerSettings) -> bytes:
        model = task_model_of(robot_of("iiwa7"), settings, kernel_model("dual_iiwa7").tasks.chain)
        return b"".join(array.tobytes() for array in arrays_in(model))

    numbers = {name: 0.4 * value for name, value in usual if isinstance(value, float)}
    found = {name for name, value in numbers.items() if arrays(usual.model_copy(update={name: value})) != arrays(usual)}
    assert found | {"min_distance", "separation_gain"} == set(LIVE)


@pytest.mark.slow
def test_after_a_reset_every_pair_keeps_as_much_distance_as_a_posture_with_close_bodies_allows(
    controller: CartesianController,
) -> None:
    run = Driven(controller)
    run.drive(4.0, SCENARIOS["crossing"])
    for changed in (FAR, NEAR, FAR):
        assert controller.change({"min_distance": changed}) is None
        if changed == FAR:
            controller.reset(run.q)
        least = (controller.robot.distance_values(run.q) - controller.kept_distances).min()
        assert controller.step({}, 0.0).report.margin == pytest.approx(least, abs=2e-6)
    run.contract.start(run.q)
    before = run.q
    run.drive(0.5)
    np.testing.assert_allclose(run.q, before, atol=1e-9)
    assert controller.kept_distances.min() < 0.02
    assert run.contract.uncertified == 0


@pytest.mark.slow
def test_a_reset_to_a_posture_with_close_bodies_reduces_kept_distances_so_that_the_arms_can_rest(
    controller: CartesianController,
) -> None:
    run = Driven(controller)
    run.drive(4.0, SCENARIOS["crossing"])
    near = run.q
    controller.reset(run.robot.home)
    assert controller.change({"min_distance": FAR}) is None
    for _ in range(500):
        controller.step({}, DT)
    assert controller.narrow_pair is None
    again = Driven(controller, near)
    again.drive(0.5)
    np.testing.assert_allclose(again.q, near, atol=1e-6)
    assert again.contract.uncertified == 0


@pytest.mark.slow
def test_after_a_reset_arms_within_their_buffer_rest_and_the_buffer_grows_as_they_move_apart(
    controller: CartesianController,
) -> None:
    run = Driven(controller)
    run.drive(4.0, SCENARIOS["crossing"])
    run.drive(0.5)
    within = ControllerSettings(min_distance=NEAR + margins(run).min() - 0.001)
    left = Driven(CartesianController(controller.robot, within), run.q)
    left.drive(0.5)
    np.testing.assert_allclose(left.q, run.q, atol=1e-6)
    left.drive(3.0, run.start)
    left.drive(3.0, lambda t, _: SCENARIOS["crossing"](t, run.start))
    left.drive(0.5)
    assert margins(left).min() > 0.002
    assert left.contract.uncertified == 0


def test_the_kept_distance_of_an_approaching_pair_never_exceeds_its_distance_during_the_certified_stop(
    controller: CartesianController,
) -> None:
    run, robot = Driven(controller), controller.robot
    lost = np.zeros(0)
    # The loop ends when a stop would bring some pair closer by more than 4 mm, to a distance clearly below FAR.
    while run.ticks < 800 and not (lost > 0.004).any():
        run.drive(0.01, SCENARIOS["crossing"])
        stop = controller.stop_deceleration
        ends = robot.distance_values(run.q + run.v * np.abs(run.v) / (2.0 * stop))
        lost = np.where(ends < FAR - 0.004, robot.distance_values(run.q) - ends, 0.0)
    assert (lost > 0.004).any()
    assert controller.change({"min_distance": FAR}) is None
    controller.reset(run.q, run.v)  # After the reset, pairs keep at once as much distance as they can.
    stop = controller.stop_deceleration
    for share in np.linspace(0.0, 1.0, 41):
        time = np.minimum(share * (np.abs(run.v) / stop).max(), np.abs(run.v) / stop)
        q = run.q + run.v * time - 0.5 * np.sign(run.v) * stop * time**2
        assert (robot.distance_values(q) - controller.kept_distances).min() >= 0.0


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"min_distance": 0.06}, "up to 0.05"),
        ({"acceleration_limit": 5.0}, r"control.acceleration_limit = 5.0: while a controller runs: min_distance, "),
        ({"position_gain": 0.0}, "control.position_gain = 0.0: allowed: more than 0"),
        ({"position_gain": 1.0, "min_distance": -1.0}, "control.min_distance"),
    ],
    ids=["pairs are not watched", "not a live one", "out of range", "as a whole"],
)
def test_a_change_that_is_not_allowed_is_refused_with_the_reason_and_changes_nothing(
    controller: CartesianController, values: dict[str, float], reason: str
) -> None:
    before = controller.settings
    refusal = controller.change(values)
    assert refusal is not None
    assert reason in refusal
    assert controller.settings is before


def test_a_min_distance_is_refused_with_the_name_of_the_pair_if_the_home_posture_does_not_keep_it(
    controller: CartesianController,
) -> None:
    nearest = min(controller.robot.distances(controller.robot.home), key=lambda pair: pair.distance)
    # At home, the pair has this distance, but it does not have this distance plus distance_buffer.
    refusal = controller.change({"min_distance": nearest.distance - 0.001})
    assert refusal is not None
    assert nearest.name_a in refusal


def _way(controller: CartesianController) -> np.ndarray:
    """Return the postures (ticks, nv) [rad] while both tools move across each other, and then upwards."""
    start = {arm: controller.tool_pose(arm) for arm in controller.robot.arms}
    goals = [SCENARIOS[name](0.0, start) for name in ("crossing", "overhead") for _ in range(400)]
    return np.array([controller.step(goal, DT).q for goal in goals])
