"""Scripted hands have the properties on which the demo and the tests of tracking rely."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import Robot, load_config
from q2r2_control.errors import ConfigError
from q2r2_control.inputs.assembly import WORKS
from q2r2_control.inputs.played import HeadsetSampling
from q2r2_control.inputs.scripted import START, TRAJECTORIES, ScriptedInput, hurried, place_of, trajectory_named
from q2r2_control.inputs.way_points import HOME, HandWork, WayPoints, minimum_jerk
from q2r2_control.types import SIDES, HandSample, HapticFeedback

EVERY = pytest.mark.parametrize("trajectory", list(TRAJECTORIES))


def play(script: ScriptedInput, duration: float, dt: float = 0.01, start: float = 0.0) -> list[HandSample]:
    script.start()
    return [sample for tick in range(round(duration / dt)) for sample in script.poll(start + tick * dt)]


def flat(samples: list[HandSample]) -> list[tuple[object, ...]]:
    return [(s.hand, s.pose_stamp, s.inputs, *s.position.tolist(), *s.quaternion.tolist()) for s in samples]


def test_equal_seeds_give_equal_samples_however_often_the_loop_polls() -> None:
    often, seldom = (play(ScriptedInput("grasp", human=True, seed=3), 6.0, dt) for dt in (0.001, 0.1))
    assert len(seldom) > 500
    assert flat(often)[: len(seldom)] == flat(seldom)


def test_stamps_are_times_of_the_callers_clock_and_never_later_than_the_time_of_the_poll() -> None:
    script = ScriptedInput("circle", human=True)
    script.start()
    last = dict.fromkeys(SIDES, -math.inf)
    for now in np.arange(5000.0, 5010.0, 0.01).tolist():
        for sample in script.poll(now):
            assert last[sample.hand] < sample.pose_stamp <= now
            assert sample.inputs_stamp == sample.pose_stamp
            last[sample.hand] = sample.pose_stamp


@pytest.mark.slow
@EVERY
@pytest.mark.parametrize("hand", SIDES)
def test_hands_move_smoothly_and_slowly_and_only_over_short_distances(trajectory: str, hand: str) -> None:
    script, dt = ScriptedInput(trajectory), 0.01
    poses = [script.hand_pose(hand, tick * dt) for tick in range(2100)]
    way = np.array([pose.translation - poses[0].translation for pose in poses])
    # In precision mode, a hand moves farther than its tool.
    lowest = -0.211 if trajectory == "peg" else -0.164 if trajectory in WORKS else 0.0
    assert way[:, 2].min() > lowest - 1e-9
    assert np.abs(way).max() <= (0.355 if trajectory == "carry" else 0.25) + 1e-9
    velocity = np.diff(way, axis=0) / dt
    assert np.linalg.norm(velocity, axis=1).max() < 0.5
    assert np.abs(np.diff(velocity, axis=0) / dt).max() < 1.5
    turns = [pin.log3(b.rotation @ a.rotation.T) / dt for a, b in itertools.pairwise(poses)]
    assert np.abs(turns).max() < 1.5
    assert np.abs(np.diff(turns, axis=0) / dt).max() < 5.0
    for t in np.arange(0.0, 12.0, 0.1).tolist():
        before, after = script.hand_pose(hand, t), script.hand_pose(hand, t + 0.01)
        twist = script.hand_twist(hand, t + 0.005)
        np.testing.assert_allclose(before.translation + 0.01 * twist.linear, after.translation, atol=2e-6)
        np.testing.assert_allclose(pin.exp3(0.01 * twist.angular) @ before.rotation, after.rotation, atol=2e-5)


@EVERY
def test_the_hands_rest_until_the_first_press_has_engaged_the_arms(trajectory: str) -> None:
    samples = [s for s in play(ScriptedInput(trajectory), 2.0) if s.pose_stamp < 1.1]
    assert any(s.inputs.button_lower for s in samples)
    assert not samples[0].inputs.button_lower
    assert not samples[-1].inputs.button_lower
    assert np.ptp([s.position for s in samples if s.hand == "left"], axis=0).max() < 1e-12


def test_the_rotation_of_the_right_hand_mirrors_the_rotation_of_the_left_hand() -> None:
    script, reflection = ScriptedInput("rotate"), np.diag([1.0, -1.0, 1.0])
    for t in (0.0, 2.0, 5.0, 9.0, 13.0):
        left, right = (script.hand_pose(hand, 0.0).rotation.T @ script.hand_pose(hand, t).rotation for hand in SIDES)
        np.testing.assert_allclose(reflection @ left @ reflection, right, atol=1e-12)


def test_samples_come_only_between_start_and_close_and_the_motion_waits_while_nobody_polls() -> None:
    script = ScriptedInput("circle", hands=("left",))
    assert (script.connected, script.poll(0.0)) == (False, [])
    script.start()
    assert script.connected
    assert script.poll(0.0)
    assert [script.poll(now) for now in (math.nan, math.inf, -math.inf)] == [[], [], []]
    late = script.poll(1e9)
    assert 70 < len(late) < 80
    assert late[-1].pose_stamp == pytest.approx(1e9, abs=0.02)
    script.send_haptic(HapticFeedback("left", 0.5, 0.5))
    script.close()
    script.close()
    assert (script.connected, script.poll(2e9)) == (False, [])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        *(
            (
                {"trajectory": name},
                r"allowed are circle, .*peg, and meet, clash, grasp, carry, handover, stack, wipe, peg joined by \+$",
            )
            for name in ("spiral", "handover+", "circle+stack", "")
        ),
        ({"hands": ("middle",)}, "allowed are left, right"),
        ({"rate_hz": 0.0}, "rate_hz = 0"),
        ({"frequency_hz": math.nan}, "frequency_hz = nan"),
        ({"scale": 1.5}, r"scale = 1\.5: allowed is above 0 and up to 1"),
        ({"jitter": 0.01}, r"jitter = 0\.01: allowed is 0 \.\. 0\.00667"),
    ],
)
def test_a_wrong_setting_is_refused_with_what_is_allowed(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        ScriptedInput(**{"trajectory": "circle", **arguments})  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("trajectory", ["circle", "meet"])
def test_scripted_hands_for_a_cell_of_iiwa_arms_move_exactly_as_without_a_cell(trajectory: str) -> None:
    written = flat(play(ScriptedInput(trajectory), 4.0))
    for name in ("dual_iiwa7", "dual_iiwa14", "iiwa7"):
        assert flat(play(ScriptedInput.from_config(load_config(f"config/{name}.yaml"), trajectory), 4.0)) == written


def test_shorter_arms_move_shorter_distances_and_turn_by_the_same_angles() -> None:
    written, script = ScriptedInput("meet"), ScriptedInput.from_config(load_config("config/dual_xarm7.yaml"), "meet")
    for hand in SIDES:
        ways = []
        for made in (written, script):
            start, later = made.hand_pose(hand, 0.0), made.hand_pose(hand, 3.0)
            ways.append(later.translation - start.translation)
            np.testing.assert_array_equal(later.rotation, written.hand_pose(hand, 3.0).rotation)
        assert np.linalg.norm(ways[0]) > 0.05
        np.testing.assert_allclose(ways[1], 0.82 / 1.12 * ways[0], rtol=1e-3)


def test_the_home_positions_of_the_way_points_equal_the_home_positions_of_the_tools_in_the_shipped_cell() -> None:
    robot = Robot.from_config(load_config("config/dual_iiwa7.yaml"))
    for arm, home in HOME.items():
        np.testing.assert_allclose(robot.tool_pose(robot.home, arm).translation, home, atol=1e-4)


@pytest.mark.parametrize("work", WORKS.values(), ids=WORKS)
def test_the_way_points_of_every_work_have_rising_times_and_end_at_home_with_open_grippers(work: HandWork) -> None:
    for hand, points in work.tools.items():
        times = [point[0] for point in points]
        assert times == sorted(set(times))
        assert times[0] > 0.0
        assert times[-1] <= work.duration
        assert points[-1][1:] == (*HOME[hand], 0.0, 0.0)
        assert len(work.presses[hand]) % 2 == 0


@pytest.mark.parametrize("name", ["meet+grasp", "handover+stack"])
def test_the_steps_of_several_works_are_in_order_and_the_text_of_each_step_begins_with_the_name_of_its_work(
    name: str,
) -> None:
    trajectory = trajectory_named(name)
    begins, words = zip(*trajectory.steps, strict=True)
    assert begins == tuple(sorted(begins))
    assert trajectory.duration is not None
    assert begins[-1] < trajectory.duration
    assert list(dict.fromkeys(said.partition(":")[0] for said in words[1:])) == name.split("+")


def test_works_in_sequence_do_the_same_as_each_work_alone() -> None:
    both, first, second = (trajectory_named(name) for name in ("handover+stack", "handover", "stack"))
    assert second.duration is not None
    shift = WORKS["handover"].duration
    assert both.duration == pytest.approx(second.duration + shift)
    for hand in SIDES:
        for t in np.linspace(0.0, shift, 40):
            np.testing.assert_allclose(both.displacement(hand, t, 1.0), first.displacement(hand, t, 1.0), atol=1e-12)
        for t in np.linspace(2.0, second.duration, 40):
            expected = second.displacement(hand, t, 1.0)
            np.testing.assert_allclose(both.displacement(hand, t + shift, 1.0), expected, atol=1e-9)
        presses = first.upper_presses[hand] + tuple(t + shift for t in second.upper_presses[hand])
        assert both.upper_presses[hand] == pytest.approx(presses)


def test_in_precision_mode_a_hand_moves_four_times_as_far_as_the_tool_and_pushes_its_stick() -> None:
    trajectory, tool = trajectory_named("peg"), WayPoints(WORKS["peg"].tools["right"])
    ((begins, ends),) = trajectory.precise
    for first, last, farther in ((3.0, begins, 1.0), (begins, ends, 4.0), (ends, 24.0, 1.0)):
        for t, until in itertools.pairwise(np.linspace(first, last - 1e-6, 50).tolist()):
            assert trajectory.inputs("right", t).thumb_stick_vertical == float(farther > 1.0)
            way = trajectory.displacement("right", until, 1.0)[0] - trajectory.displacement("right", t, 1.0)[0]
            of_tool = tool.at(until - START)[0] - tool.at(t - START)[0]
            np.testing.assert_allclose(way, farther * of_tool, atol=1e-9)
    assert not trajectory_named("meet").precise


def test_a_motion_reaches_each_way_point_at_its_time_and_rests_there() -> None:
    way = WayPoints([(1.0, 0.0, 0.0, 0.0, 0.0, 0.0), (2.0, 0.1, 0.0, 0.2, 0.0, 0.0), (4.0, 0.1, -0.3, 0.2, 0.4, 1.2)])
    for t, place, tilt, turn in (
        (0.0, (0.0, 0.0, 0.0), 0.0, 0.0),
        (1.5, (0.05, 0.0, 0.1), 0.0, 0.0),
        (2.0, (0.1, 0.0, 0.2), 0.0, 0.0),
        (9.0, (0.1, -0.3, 0.2), 0.4, 1.2),
    ):
        where, rotation = way.at(t)
        np.testing.assert_allclose(where, place, atol=1e-12)
        tilted = pin.rpy.rpyToMatrix(tilt, 0.0, 0.0) @ pin.rpy.rpyToMatrix(0.0, 0.0, turn)
        np.testing.assert_allclose(pin.exp3(rotation), tilted, atol=1e-12)
    for t in (1.0, 2.0, 4.0):
        assert np.linalg.norm(way.at(t + 1e-4)[0] - way.at(t - 1e-4)[0]) / 2e-4 < 1e-5
    assert [minimum_jerk(fraction) for fraction in (-1.0, 0.0, 0.5, 1.0, 2.0)] == [0.0, 0.0, 0.5, 1.0, 1.0]


@pytest.mark.slow
def test_the_headset_loses_shaky_hands_for_a_second_and_they_engage_again_and_complete_the_work() -> None:
    for seed in (3, 6, 12):  # The loss is early, late, or moved to a time after a press.
        calm, hasty = trajectory_named("carry"), hurried(trajectory_named("carry"), seed)
        assert hasty.duration is not None
        samples = [s for s in play(ScriptedInput("carry", shaky=True, seed=seed), hasty.duration) if s.hand == "left"]
        stamps = [sample.pose_stamp for sample in samples]
        gaps = sorted((b - a, a) for a, b in itertools.pairwise(stamps))
        assert 1.0 <= gaps[-1][0] < 1.1
        assert gaps[-2][0] < 0.1
        seen_again = gaps[-1][1] + gaps[-1][0]
        presses = [
            a.pose_stamp for b, a in itertools.pairwise(samples) if a.inputs.button_lower > b.inputs.button_lower
        ]
        assert len(presses) == len(calm.lower_presses) + 1
        assert min(press for press in presses if press > gaps[-1][1]) == pytest.approx(seen_again + 0.3, abs=0.1)
        opened = [a for b, a in itertools.pairwise(samples) if a.inputs.button_upper > b.inputs.button_upper]
        assert len(opened) == len(calm.upper_presses["left"])
        still = [hasty.displacement("left", t, 0.25)[0] for t in np.linspace(hasty.lost[0], hasty.lost[0] + 2.1, 20)]
        assert np.ptp(still, axis=0).max() < 1e-9
        way = [hasty.displacement("left", t, 0.25)[0] for t in np.arange(0.0, hasty.duration, 0.01)]
        assert np.ptp(way, axis=0) == pytest.approx((0.14, 0.15, 0.148), abs=1e-3)


def test_shaky_hands_tremble_twice_as_far_as_calm_hands_and_at_a_lower_frequency() -> None:
    def trembling(shaky: bool) -> tuple[float, float]:
        sampling = HeadsetSampling("left", 1, position_noise=0.0, tremor=True, shaky=shaky)
        x = [sampling.measured(pin.SE3.Identity(), t).translation[0] for t in np.arange(0.0, 10.0, 0.005)]
        spectrum = np.abs(np.fft.rfft(x))
        return max(map(abs, x)), float(np.fft.rfftfreq(len(x), 0.005)[spectrum.argmax()])

    (most, frequency), (least, _) = trembling(True), trembling(False)
    assert most == pytest.approx(2e-3, rel=0.1)
    assert 5.5 <= frequency <= 6.5
    assert most == pytest.approx(2.0 * least, rel=0.2)


def test_hands_reach_for_the_parts_at_the_positions_to_which_the_seed_has_shifted_them() -> None:
    places = {seed: place_of(seed, 0.02) for seed in range(20)}
    assert len(set(places.values())) == 20
    assert 0.015 < np.abs(list(places.values())).max() <= 0.02
    x, y = places[3]
    moved = trajectory_named("grasp", places[3])
    assert moved.duration == TRAJECTORIES["grasp"].duration
    hand, way = max(WORKS["grasp"].tools.items(), key=lambda item: len(item[1]))
    lowest = min(way, key=lambda point: point[3])
    plain, elsewhere = (
        script.displacement(hand, START + lowest[0], 0.25)[0] for script in (TRAJECTORIES["grasp"], moved)
    )
    np.testing.assert_allclose(elsewhere - plain, (x, y, 0.0), atol=1e-9)


def test_a_spread_of_parts_is_refused_for_a_trajectory_without_parts() -> None:
    with pytest.raises(ConfigError, match="'circle': has no parts to spread; allowed: "):
        ScriptedInput("circle", spread=0.01)
