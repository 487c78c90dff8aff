"""The filter of hand poses: its delay, how it reduces tremor, and that its output never jumps."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.teleop import FilterSettings
from q2r2_control.quaternions import floats_of, se3_of
from q2r2_control.teleop.filters import OneEuro, PoseFilter
from tests.teleop.hands import pose

Path = Callable[[float], pin.SE3]
STILL = pose(0.1, 0.2, 0.3, (0.4, 0.5, 0.6))


def follow(path: Path, duration: float = 3.0, dt: float = 0.002, period: float = 1 / 75) -> tuple[float, list[pin.SE3]]:
    """Filter the samples of a hand that moves along ``path``. Return the filter's delay [s] and all its outputs."""
    pose_filter = PoseFilter(FilterSettings())
    pose_filter.reset(floats_of(path(0.0)), 0.0)
    due, outputs = period, []
    for tick in range(round(duration / dt)):
        now = tick * dt
        while due <= now:
            pose_filter.add(floats_of(path(due)), due, now)
            due += period
        outputs.append(se3_of(pose_filter.at(now)))
    return FilterSettings().delay, outputs


@pytest.mark.parametrize("dt", [0.001, 0.02], ids="loop of {} s".format)
@pytest.mark.parametrize("speed", [0.02, 2.0], ids="{} per second".format)
def test_the_output_lags_a_steady_motion_by_exactly_the_stated_delay_at_any_speed(speed: float, dt: float) -> None:
    def path(t: float) -> pin.SE3:
        return pose(speed * t, 0.7 * speed * t, -0.5 * speed * t, (0.0, 0.0, speed * t))

    delay, outputs = follow(path, dt=dt)
    for tick in range(round(2.0 / dt), len(outputs)):
        missing = path(tick * dt - delay).actInv(outputs[tick])
        assert np.linalg.norm(missing.translation) < speed * 1e-3
        assert np.linalg.norm(pin.log3(missing.rotation)) < speed * 1e-3


@pytest.mark.parametrize("frequency", [8.0, 12.0], ids="{} Hz".format)
def test_the_filter_reduces_the_tremor_of_a_resting_hand_to_less_than_two_fifths(frequency: float) -> None:
    def path(t: float) -> pin.SE3:
        wave = math.sin(2 * math.pi * frequency * t)
        return pose(0.001 * wave, 0.0, 0.0, (0.0, math.radians(0.3) * wave, 0.0))

    _, outputs = follow(path)
    rest = outputs[500:]
    assert max(abs(output.translation[0]) for output in rest) < 0.4e-3
    assert max(abs(pin.log3(output.rotation)[1]) for output in rest) < math.radians(0.4 * 0.3)


def test_the_overshoot_after_a_sudden_stop_of_the_hand_is_bounded() -> None:
    def path(t: float) -> pin.SE3:
        return pose(0.3 * min(t, 1.0))

    _, outputs = follow(path)
    assert max(output.translation[0] for output in outputs) - 0.3 < 1 / (2 * math.pi * FilterSettings().beta)
    assert outputs[-1].translation[0] == pytest.approx(0.3, abs=1e-5)


def largest_step(arrivals: list[tuple[float, list[tuple[float, float]]]]) -> float:
    """Return the largest step of the output between two ticks of 1 ms [m].

    Each element of ``arrivals`` is a time of receipt [s] with the samples (stamp [s], x [m]) that arrive at this time.
    """
    pose_filter = PoseFilter(FilterSettings())
    pose_filter.reset(floats_of(pose()), 0.0)
    outputs: list[float] = []
    queue = list(arrivals)
    for tick in range(2000):
        now = tick * 0.001
        while queue and queue[0][0] <= now:
            for stamp, x in queue.pop(0)[1]:
                pose_filter.add(floats_of(pose(x)), stamp, now)
        outputs.append(pose_filter.at(now)[0][0])
    return float(np.abs(np.diff(outputs)).max())


@pytest.mark.parametrize(
    "arrivals",
    [
        [(0.5, [(0.5, 0.1)])],
        [(0.5, [(0.5 - 0.001 * back, 0.1 - 0.002 * back) for back in range(50, -1, -1)])],
        [(0.5, [(0.5, 0.05), (0.5, 0.1), (0.5, 0.1)])],
        [(0.5, [(0.2, 0.1)])],
        [(0.5, [(0.5, 0.1)]), (0.501, [(0.501, 0.0)]), (0.502, [(0.502, 0.1)])],
        [(0.1 * n, [(0.1 * n, 0.05 * n)]) for n in range(1, 15)],
    ],
    ids=["a step", "a burst of 51", "doubled stamps", "a late stamp", "samples a millisecond apart", "long gaps"],
)
def test_the_output_is_continuous_after_gaps_and_bursts_of_the_stream(
    arrivals: list[tuple[float, list[tuple[float, float]]]],
) -> None:
    assert largest_step(arrivals) < 0.006


def speeds(arrivals: list[tuple[float, float]], velocity: float, since: float) -> np.ndarray:
    """Return the speed of the output at each tick after ``since`` [s], for a hand with constant ``velocity`` [m/s].

    ``arrivals`` contains the time of measurement and the time of receipt of each sample [s].
    """
    pose_filter = PoseFilter(FilterSettings())
    pose_filter.reset(floats_of(pose()), 0.0)
    outputs, queue = [], list(arrivals)
    for tick in range(3000):
        now = tick * 0.001
        while queue and queue[0][1] <= now:
            measured, received = queue.pop(0)
            pose_filter.add(floats_of(pose(velocity * measured)), received, now)
        outputs.append(pose_filter.at(now)[0][0])
    return np.diff(outputs)[round(since / 0.001) :] / 0.001


def test_jitter_in_the_times_of_receipt_hardly_changes_the_speed_of_the_output() -> None:
    late = np.random.default_rng(5).exponential(0.0015, 300).clip(max=0.01)
    arrivals = [(n / 75, n / 75 + late[n]) for n in range(300)]
    assert np.std(speeds(arrivals, 0.5, 1.0)) < 0.04 * 0.5


def test_after_a_gap_the_output_catches_up_with_the_hand_at_a_bounded_speed() -> None:
    arrivals = [(n / 75, n / 75) for n in range(300) if not 1.5 < n / 75 < 1.6]
    assert speeds(arrivals, 0.5, 1.0).max() < 3.5 * 0.5


def test_with_beta_0_the_filter_is_of_first_order_and_min_cutoff_gives_its_time_constant() -> None:
    # With beta = 0, a tick corrects dt / (tau + dt) of the error. The filter shifts its input ahead by (tau - delay) v.
    dt, tau, derivative_tau = 0.002, 1.0 / (2.0 * math.pi * 1.5), 1.0 / (2.0 * math.pi * 4.0)
    one_euro = OneEuro(min_cutoff=1.5, beta=0.0, derivative_cutoff=4.0, delay=0.03)
    share = dt / (tau + dt)
    assert one_euro.correction((0.01, 0.0, 0.0), (0.0, 0.0, 0.0), dt) == pytest.approx((0.01 * share, 0.0, 0.0))
    velocity = 0.001 / (derivative_tau + dt)
    expected = share * (0.01 + (tau - 0.03) * velocity)
    assert one_euro.correction((0.01, 0.0, 0.0), (0.001, 0.0, 0.0), dt) == pytest.approx((expected, 0.0, 0.0))


def test_the_filtered_quaternion_keeps_its_length_of_1_for_20_seconds() -> None:
    pose_filter = PoseFilter(FilterSettings())
    pose_filter.reset(floats_of(STILL), 0.0)
    for tick in range(20_000):
        now = tick * 0.001
        if tick % 13 == 0:
            turn = math.sin(now), math.cos(1.3 * now), 0.5 * now % 3.0
            pose_filter.add(floats_of(pose(turn=turn)), now, now)
        _, rotation = pose_filter.at(now)
        assert math.hypot(*rotation) == pytest.approx(1.0, abs=4e-15)
