"""How does a filter feel to an operator: how late is the tool, how does it stop, how much tremor and noise is left?

A scripted hand oscillates at single frequencies, reaches, trembles, rests, and moves and stops. The tool is measured
through the whole chain: samples at a headset's rate, teleoperation, the controller, and an arm in MuJoCo. A tone is a
sine motion of one frequency. Its delay and gain come from least-squares fits of a sine and a cosine to the paths of
hand and tool. Real hands do not move in tones, so reaching motions (reaches) are measured, too. The delay of a reach is
the delay at which the velocities of hand and tool have their highest correlation. The figures for a tremor within a
band count all motion of the tool, also outside the band.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pinocchio as pin
import typer

from q2r2_control.cli.output import DEMO_CONFIG, Json, print_progress, print_report
from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.teleop import FilterSettings
from q2r2_control.inputs.played import HandButtons, HeadsetSampling, PlayedInput
from q2r2_control.inputs.scripted import HANDS_AT_REST
from q2r2_control.inputs.way_points import minimum_jerk
from q2r2_control.judging.motion import Track, delays_behind
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick
from q2r2_control.types import Array, HandInputs
from q2r2_control.viewer.tables import record_table

Way = Callable[[float], float]  # Displacement of a hand along one axis [m] as a function of time [s].

# Filters to compare with the cell's own. PRECISION suppresses most of the tremor, and SPEED has a short delay.
PRECISION = FilterSettings(
    interpolation_delay=0.02, smoothing_delay=0.06, min_cutoff=0.8, beta=3.0, rotation_beta=1.0, derivative_cutoff=2.0
)
SPEED = FilterSettings(
    interpolation_delay=0.015,
    smoothing_delay=0.005,
    min_cutoff=5.0,
    beta=30.0,
    rotation_beta=10.0,
    derivative_cutoff=2.0,
)
OTHERS = {"precision": PRECISION, "speed": SPEED}

SETTLING_S = 0.7  # Time before a tone or a tremor is measured, in which the motion settles [s].
ARM, HAND = "left", "left"
MOTIONS = ((0.5, 0.06), (1.0, 0.04), (2.0, 0.02))  # Frequency [Hz] and amplitude [m] of deliberate motions.
TREMOR_FREQUENCIES = (8.0, 10.0, 12.0)  # Frequencies of tremors [Hz].
TREMOR_AMPLITUDE = 0.5e-3  # Amplitude of a tremor [m].
SLOW_SPEED = 0.03  # Speed of a hand that moves and trembles [m/s].
SENSOR_NOISE = 2e-4  # Standard deviation of the sensor's noise along each axis [m].
# For a hand at rest: standard deviations of the sensor's noise [mm], and number of times that its arm is paused.
RESTING_NOISES, PAUSES = (0.2, 0.6, 1.0), 100
STOP_SPEED, STOP_TIME = 0.3, 0.1  # Speed of a hand that stops [m/s], and time from that speed to rest [s].
# Length [m] and time [s] of each reach, and the rest after it [s]. The hand moves to and fro, and rests after each
# move. Peak speeds are 0.16 to 0.63 m/s, which the arm can follow sidewards.
REACHES, REACH_REST_S = ((0.1, 0.6), (0.1, 1.2), (0.2, 0.8), (0.3, 1.0), (0.4, 1.2)), 0.3
TREMOR_BAND, TREMOR_BAND_RMS = (8.0, 12.0), 1e-3  # Frequencies [Hz] and RMS [m] of a tremor within a band.
_BAND_PERIOD, _BAND_SEED = 4.0, 0  # Time after which the tremor within a band repeats [s], and seed of its phases.
# Start and end of the press that engages, and start of the hand's motion [s].
_PRESS_INTERVAL, _MOTION_BEGINS_S = (0.2, 0.35), 0.8
_MEASURED_S = 2.0  # Time for which every tone is measured [s].
# Duration of the run at rest, and time when the hand that stops begins to slow down [s].
_REST_RUN_S, _STOP_BEGINS_S = 3.0, 0.4
_SIDEWARDS, _UP = 1, 2  # Indices of axes.
_ENGAGEMENT_PERIOD_S = 0.6  # Time from one engagement to the next. The arm is engaged for half of it [s].
_LONGEST_TICK_S = 0.05  # Longest period of a tick [s].
NOTES = (
    f"pauses: Distance between the tool's places before and after {PAUSES} pauses, for a hand at rest whose samples "
    f"have a noise of {RESTING_NOISES} mm.",
    "All figures are from the hand to the measured tool of an arm in MuJoCo, in position mode. Samples come at 72 to "
    "76 Hz.",
    "filter delay: Delay of the filter alone, from its settings.",
    "delays, gains: Figures for hand motions of "
    + ", ".join(f"{frequency:g} Hz, {1e3 * amplitude:g} mm" for frequency, amplitude in MOTIONS)
    + ".",
    f"tremors: Gains at {TREMOR_FREQUENCIES} Hz for a tremor of {1e3 * TREMOR_AMPLITUDE:g} mm, of a hand that moves at "
    f"{1e3 * SLOW_SPEED:g} mm/s.",
    "reaches: Delay for minimum-jerk motions of 0.1 to 0.4 m in 0.6 to 1.2 s, by correlation of velocities.",
    f"band: Gain for a flat tremor of {TREMOR_BAND[0]:g} to {TREMOR_BAND[1]:g} Hz and {1e3 * TREMOR_BAND_RMS:g} mm "
    "RMS. All motion of the tool counts.",
    f"noise: RMS of the tool's motion if each sample has a noise of {1e6 * SENSOR_NOISE:g} um.",
    f"stop: A hand at {STOP_SPEED:g} m/s stops in {STOP_TIME:g} s. The delay ends when the tool stays within 2 mm of "
    "its rest.",
)


@dataclass(frozen=True, slots=True)
class FeelFigures:
    """The figures of one filter. Delays and gains compare the motion of the measured tool with the hand's motion."""

    name: str
    filter_delay_ms: float  # Delay of the filter alone, computed from its settings.
    delays_ms: tuple[float, ...]  # Delay for each of :data:`MOTIONS`.
    gains_db: tuple[float, ...]  # Gain for each of :data:`MOTIONS`.
    # Gain for each of :data:`TREMOR_FREQUENCIES` of a hand that moves at :data:`SLOW_SPEED`.
    tremors_db: tuple[float, ...]
    # Gain for the middle frequency of :data:`TREMOR_FREQUENCIES` of a hand that otherwise rests.
    tremor_at_rest_db: float
    # Delay of the tool behind the hand over all reaching motions :data:`REACHES` together [ms]. It is NaN if the tool
    # does not follow.
    reach_delay_ms: float
    # Largest delay of the tool behind the hand among the reaching motions :data:`REACHES` [ms]. It is NaN if the tool
    # does not follow.
    worst_reach_delay_ms: float
    band_db: float  # Gain for a tremor in :data:`TREMOR_BAND` of a hand that moves at :data:`SLOW_SPEED`.
    band_at_rest_db: float  # Gain for a tremor in :data:`TREMOR_BAND` of a hand that otherwise rests.
    noise_um: float  # RMS of the tool's motion along the axis with the largest RMS, for a hand at rest.
    stop_delay_ms: float  # Time from the end of the hand's motion until the tool stays within 2 mm of its end position.
    overshoot_mm: float  # Largest distance of the tool beyond its position at rest.
    overshoot_percent: float  # Overshoot as a share of the path of the hand that stops.
    pauses_mm: tuple[float, ...]  # Drift of the tool over all pauses, for each of :data:`RESTING_NOISES`.


def run_feel(config: Config) -> list[FeelFigures]:
    """Measure the cell's filter, and the filters :data:`OTHERS`."""
    filters = {"this cell": config.teleop.filter} | OTHERS
    plain = config.model_copy(update={"mujoco": config.mujoco.model_copy(update={"objects": {}})})
    robot = Robot.from_config(plain)
    plant = MujocoPlant(robot, plain)
    figures = []
    for name, settings in filters.items():
        print_progress(name)
        figures.append(_measure(name, plain, robot, plant, settings))
    return figures


def _measure(name: str, config: Config, robot: Robot, plant: MujocoPlant, settings: FilterSettings) -> FeelFigures:
    teleop = config.teleop.model_copy(update={"filter": settings})
    config = config.model_copy(update={"teleop": teleop})

    def run(way: Way, lasts: float, noise: float = 0.0, axis: int = _UP, presses: HandButtons = _buttons) -> _Log:
        log = _Log(way, noise, axis, presses)
        pipeline = Pipeline(config, robot, log.hands, plant)
        pipeline.listeners.append(log.take)
        pipeline.run(_MOTION_BEGINS_S + lasts, realtime=False)
        if not log.reaches(lasts):
            raise KeyboardInterrupt  # A signal has ended the run early, so its figures mean nothing.
        return log

    def band(speed: float) -> float:
        trembling = tremor(TREMOR_BAND, TREMOR_BAND_RMS, _BAND_PERIOD, _BAND_SEED, speed)
        return run(trembling, SETTLING_S + _BAND_PERIOD, axis=_SIDEWARDS).attenuation(_BAND_PERIOD)

    lasts = SETTLING_S + _MEASURED_S
    motions = [run(tone(*motion), lasts).tone(motion[0]) for motion in MOTIONS]
    tremors = [run(tone(each, TREMOR_AMPLITUDE, SLOW_SPEED), lasts).tone(each)[1] for each in TREMOR_FREQUENCIES]
    at_rest = TREMOR_FREQUENCIES[len(TREMOR_FREQUENCIES) // 2]
    ends = np.cumsum([0.0, *(2.0 * (time + REACH_REST_S) for _, time in REACHES)])
    reached = run(reaches(REACHES, REACH_REST_S), ends[-1], axis=_SIDEWARDS)
    noise = run(lambda t: 0.0, _REST_RUN_S, SENSOR_NOISE).noise()
    pauses = [
        run(lambda t: 0.0, (PAUSES + 1) * _ENGAGEMENT_PERIOD_S, 1e-3 * each, presses=_again_and_again).moved()
        for each in RESTING_NOISES
    ]
    stop_delay, overshoot = run(stop(STOP_SPEED, STOP_TIME, _STOP_BEGINS_S), _STOP_BEGINS_S + STOP_TIME + 1.5).stop()
    return FeelFigures(
        name=name,
        filter_delay_ms=1e3 * (settings.interpolation_delay + settings.smoothing_delay),
        delays_ms=tuple(1e3 * delay for delay, _ in motions),
        gains_db=tuple(gain for _, gain in motions),
        tremors_db=tuple(tremors),
        tremor_at_rest_db=run(tone(at_rest, TREMOR_AMPLITUDE), lasts).tone(at_rest)[1],
        reach_delay_ms=1e3 * reached.delay(0.0, ends[-1]),
        worst_reach_delay_ms=1e3 * float(np.max([reached.delay(*times) for times in pairwise(ends)])),
        band_db=band(SLOW_SPEED),
        band_at_rest_db=band(0.0),
        noise_um=1e6 * noise,
        stop_delay_ms=1e3 * stop_delay,
        overshoot_mm=1e3 * overshoot,
        overshoot_percent=1e2 * overshoot / (STOP_SPEED * _STOP_BEGINS_S),
        pauses_mm=tuple(1e3 * moved for moved in pauses),
    )


class _Log:
    """The paths of hand and tool in a run in which one hand moves along an axis, sampled at a headset's rate."""

    def __init__(self, way: Way, noise: float, axis: int, presses: HandButtons) -> None:
        self._way, self._axis = way, axis
        samplings = {hand: HeadsetSampling(hand, 0, position_noise=noise) for hand in HANDS_AT_REST}
        self.hands = PlayedInput(self._pose, presses, samplings)
        self._t: list[float] = []
        self._tool: list[Array] = []
        self._asked: list[float] = []

    def take(self, tick: Tick) -> None:
        """Store the positions of hand and tool at a tick."""
        way = self.hands.hand_pose(HAND, tick.now).translation - HANDS_AT_REST[HAND].translation
        self._t.append(tick.t - _MOTION_BEGINS_S)
        self._asked.append(float(way[self._axis]))
        self._tool.append(tick.tools[ARM].translation.copy())

    def reaches(self, lasts: float) -> bool:
        """Return whether the run lasted at least ``lasts`` [s]."""
        return bool(self._t) and self._t[-1] > lasts - _LONGEST_TICK_S

    def tone(self, frequency: float) -> tuple[float, float]:
        """Return delay [s] and gain [dB] of the tool for a tone of this ``frequency`` [Hz]."""
        t, asked, tool = self._from(SETTLING_S)
        basis = np.stack((np.sin(2 * np.pi * frequency * t), np.cos(2 * np.pi * frequency * t), np.ones_like(t), t), 1)
        (hand_sin, hand_cos, *_), (tool_sin, tool_cos, *_) = (
            np.linalg.lstsq(basis, way, rcond=None)[0] for way in (asked, tool)
        )
        turn = complex(hand_sin, hand_cos) / complex(tool_sin, tool_cos)
        delay = (math.atan2(turn.imag, turn.real) % (2.0 * math.pi)) / (2.0 * math.pi * frequency)
        return delay, -20.0 * math.log10(abs(turn))

    def noise(self) -> float:
        """Return the RMS of the tool's motion about its mean position, along the axis with the largest RMS [m]."""
        chosen = np.array(self._t) >= 1.0
        return float(np.array(self._tool)[chosen].std(axis=0).max())

    def delay(self, begin: float, end: float) -> float:
        """Return the delay of the tool behind the hand, over their motion from ``begin`` to ``end`` [s].

        The delay is NaN if the tool does not follow.
        """
        t, asked, tool = self._from(-math.inf)
        hand, follower = (Track(t, way[:, None]) for way in (asked, tool))
        (found,) = delays_behind(hand, [follower], t[(t >= begin) & (t < end)])
        return math.nan if found is None else found

    def attenuation(self, period: float) -> float:
        """Return the RMS of the tool's motion over a ``period`` [s], divided by the RMS of the hand's motion [dB].

        Motion at a constant velocity is subtracted from both motions first.
        """
        t, asked, tool = self._from(SETTLING_S)
        within = t < SETTLING_S + period
        line = np.stack((np.ones_like(t), t), 1)[within]
        asked_rms, tool_rms = (
            math.sqrt(np.mean((way - line @ np.linalg.lstsq(line, way, rcond=None)[0]) ** 2))
            for way in (asked[within], tool[within])
        )
        return 20.0 * math.log10(tool_rms / asked_rms)

    def stop(self) -> tuple[float, float]:
        """Return the time from the end of the hand's motion to the tool's rest [s], and the tool's overshoot [m].

        The tool is at rest when it stays within 2 mm of its last position.
        """
        t, _, tool = self._from(0.0)
        ahead = tool - tool[-1]
        late = t[np.abs(ahead) > 2e-3]
        return float(late[-1]) - (_STOP_BEGINS_S + STOP_TIME), max(float(ahead.max()), 0.0)

    def moved(self) -> float:
        """Return the distance between the tool's first and last position [m]."""
        return float(np.linalg.norm(self._tool[-1] - self._tool[0]))

    def _from(self, begin: float) -> tuple[Array, Array, Array]:
        """Return, from the time ``begin`` [s] on, times [s] and the positions of hand and tool along the axis [m].

        Each array is (n,).
        """
        t = np.array(self._t)
        chosen = t >= begin
        return t[chosen], np.array(self._asked)[chosen], np.array(self._tool)[chosen, self._axis]

    def _pose(self, hand: str, t: float) -> pin.SE3:
        home = HANDS_AT_REST[hand]
        way = self._way(t - _MOTION_BEGINS_S) if hand == HAND and t >= _MOTION_BEGINS_S else 0.0
        return pin.SE3(home.rotation, home.translation + way * np.eye(3)[self._axis])


def _buttons(hand: str, t: float) -> HandInputs:
    return HandInputs(button_lower=_PRESS_INTERVAL[0] <= t < _PRESS_INTERVAL[1])


def _again_and_again(hand: str, t: float) -> HandInputs:
    return HandInputs(
        button_lower=t > _PRESS_INTERVAL[0]
        and (t - _PRESS_INTERVAL[0]) % (_ENGAGEMENT_PERIOD_S / 2.0) < _ENGAGEMENT_PERIOD_S / 4.0
    )


def tone(frequency: float, amplitude: float, speed: float = 0.0) -> Way:
    """Return a sine of ``frequency`` [Hz] and ``amplitude`` [m], added to a motion at constant ``speed`` [m/s].

    The sine grows from zero within the first half of :data:`SETTLING_S`.
    """

    def way(t: float) -> float:
        return amplitude * _grown(t) * math.sin(2.0 * math.pi * frequency * t) + speed * t

    return way


def tremor(band: tuple[float, float], rms: float, period: float, seed: int, speed: float = 0.0) -> Way:
    """Return noise of this ``rms`` [m], added to a motion at constant ``speed`` [m/s].

    The noise has a spectrum that is flat within ``band`` [Hz] and zero outside. It repeats after ``period`` [s], over
    which its RMS is exact. The noise is the sum of all tones of the band that repeat after the period. These tones have
    the same amplitude, and random phases that depend on ``seed``.
    """
    low, high = (round(frequency * period) for frequency in band)
    turns = 2.0 * math.pi * np.arange(low, high + 1) / period
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * math.pi, len(turns))
    amplitude = rms * math.sqrt(2.0 / len(turns))

    def way(t: float) -> float:
        return amplitude * _grown(t) * float(np.sin(turns * t + phases).sum()) + speed * t

    return way


def stop(speed: float, ramp: float, cruises: float) -> Way:
    """Return a motion that speeds up within ``ramp`` [s] and then moves at ``speed`` [m/s].

    At the time ``cruises`` [s] it begins to stop, which also takes ``ramp`` [s].
    """

    def way(t: float) -> float:
        up = min(max(t, 0.0), ramp)
        along = min(max(t - ramp, 0.0), cruises - ramp)
        down = min(max(t - cruises, 0.0), ramp)
        return speed * (0.5 * up * up / ramp + along + down - 0.5 * down * down / ramp)

    return way


def reaches(lengths_and_times: Sequence[tuple[float, float]], rest: float) -> Way:
    """Return minimum-jerk reaches (Flash and Hogan 1985) of these lengths [m] and times [s].

    The hand makes each reach and moves back. It rests for ``rest`` [s] after each of these motions.
    """

    def way(t: float) -> float:
        for length, time in lengths_and_times:
            for to in (True, False):
                if t < time + rest:
                    done = minimum_jerk(min(max(t / time, 0.0), 1.0))
                    return length * (done if to else 1.0 - done)
                t -= time + rest
        return 0.0

    return way


def _grown(t: float) -> float:
    share = min(max(t, 0.0) / (0.5 * SETTLING_S), 1.0)
    return math.sin(0.5 * math.pi * share) ** 2


def main(json: Json = False) -> None:
    """Print what an operator feels of three filters: the cell's own filter, PRECISION and SPEED."""
    config = load_config(DEMO_CONFIG)
    figures = run_feel(config)
    table = record_table(f"{config.name}: What an operator feels of a filter", figures, NOTES)
    print_report({"cell": config.name, "filters": figures}, (table,), json)


if __name__ == "__main__":
    typer.run(main)
