"""What an operator feels of a filter: how late the tool is, what is left of tremor and noise, and how it stops.

Nothing is taken from the settings: a hand moves in tones, rests, and moves and stops, and the tool is measured, through
samples at a headset's rate, teleoperation, controller and an arm in MuJoCo. Delay and gain of a tone come from the
least-squares fit of a sine and a cosine to the hand's way and to the tool's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from q2r2_control.config import Config
from q2r2_control.config.teleop import FilterSettings
from q2r2_control.inputs.played import PlayedInput
from q2r2_control.inputs.sampling import HeadsetSampling
from q2r2_control.inputs.scripted import HANDS_AT_REST
from q2r2_control.pipeline import Pipeline
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.robot.robot import Robot
from q2r2_control.runtime.recorder import Tick
from q2r2_control.types import Array, HandInputs

# Filters to compare with the cell's own: one that lets little through, and one that is late by little.
PRECISION = FilterSettings(smoothing_delay=0.06, min_cutoff=0.8, beta=3.0, rotation_beta=1.0)
SPEED = FilterSettings(interpolation_delay=0.015, smoothing_delay=0.005, min_cutoff=5.0, beta=30.0, rotation_beta=10.0)
OTHERS = {"precision": PRECISION, "speed": SPEED}

ARM, HAND = "left", "left"
MOTIONS = ((0.5, 0.06), (1.0, 0.04), (2.0, 0.02))  # of a hand that means it [Hz], [m]
TREMORS = (8.0, 10.0, 12.0)  # [Hz]
TREMOR = 0.5e-3  # amplitude [m]
SLOWLY = 0.03  # of a hand that moves and trembles [m/s]
NOISE = 2e-4  # of the sensor, standard deviation along each axis [m]
STOP_SPEED, STOP_TIME = 0.3, 0.1  # of a hand that moves on and stops [m/s], and from that speed to rest [s]
_PRESSED, _BEGINS = (0.2, 0.35), 0.8  # [s]
_SETTLES, _MEASURED = 0.7, 2.0  # of every tone, before and while it is measured [s]
_RESTS, _CRUISES = 3.0, 0.4  # [s]


@dataclass(frozen=True, slots=True)
class FeelFigures:
    """One filter; delays are from the hand to the measured tool."""

    name: str
    filter_delay_ms: float  # as the settings say, of the filter alone
    delays_ms: tuple[float, ...]  # of each of :data:`MOTIONS`
    gains_db: tuple[float, ...]  # of the same
    tremors_db: tuple[float, ...]  # of a hand that trembles at :data:`TREMORS` while it moves at :data:`SLOWLY`
    tremor_at_rest_db: float  # of the middle one, of a hand that rests otherwise
    noise_um: float  # RMS of the tool in the worst axis, of a hand that rests
    stop_delay_ms: float  # from the hand's rest to the tool within 2 mm of its own for good
    overshoot_mm: float  # of the tool, beyond where it comes to rest


def run_feel(
    config: Config, progress: Callable[[str], None], others: Mapping[str, FilterSettings] | None = None
) -> list[FeelFigures]:
    """Measure the cell's filter and ``others``; ``progress`` is told each one's name."""
    filters = {"this cell": config.teleop.filter} | dict(OTHERS if others is None else others)
    plain = config.model_copy(update={"mujoco": config.mujoco.model_copy(update={"objects": {}})})
    robot = Robot.from_config(plain)
    plant = MujocoPlant(robot, plain)
    figures = []
    for name, settings in filters.items():
        progress(name)
        figures.append(_measure(name, plain, robot, plant, settings))
    return figures


def _measure(name: str, config: Config, robot: Robot, plant: MujocoPlant, settings: FilterSettings) -> FeelFigures:
    teleop = config.teleop.model_copy(update={"filter": settings})
    config = config.model_copy(update={"teleop": teleop})

    def run(way: Callable[[float], float], lasts: float, noise: float) -> _Log:
        log = _Log(way, noise)
        pipeline = Pipeline(config, robot, log.hands, plant)
        pipeline.listeners.append(log.take)
        pipeline.run(_BEGINS + lasts, realtime=False)
        return log

    lasts = _SETTLES + _MEASURED
    motions = [run(_tone(*motion), lasts, 0.0).tone(motion[0]) for motion in MOTIONS]
    tremors = [run(_tone(each, TREMOR, SLOWLY), lasts, 0.0).tone(each)[1] for each in TREMORS]
    at_rest = TREMORS[len(TREMORS) // 2]
    noise = run(lambda t: 0.0, _RESTS, NOISE).noise()
    stop_delay, overshoot = run(_stop, _CRUISES + STOP_TIME + 1.5, 0.0).stop()
    return FeelFigures(
        name=name,
        filter_delay_ms=1e3 * (settings.interpolation_delay + settings.smoothing_delay),
        delays_ms=tuple(1e3 * delay for delay, _ in motions),
        gains_db=tuple(gain for _, gain in motions),
        tremors_db=tuple(tremors),
        tremor_at_rest_db=run(_tone(at_rest, TREMOR), lasts, 0.0).tone(at_rest)[1],
        noise_um=1e6 * noise,
        stop_delay_ms=1e3 * stop_delay,
        overshoot_mm=1e3 * overshoot,
    )


def _tone(frequency: float, amplitude: float, speed: float = 0.0) -> Callable[[float], float]:
    """Grows within the first half of :data:`_SETTLES`, on top of a steady motion."""

    def way(t: float) -> float:
        share = min(max(t, 0.0) / (0.5 * _SETTLES), 1.0)
        return amplitude * math.sin(0.5 * math.pi * share) ** 2 * math.sin(2.0 * math.pi * frequency * t) + speed * t

    return way


def _stop(t: float) -> float:
    """Speeds up in :data:`STOP_TIME`, goes on, and stops in the same time."""
    ramp = STOP_TIME
    up = min(max(t, 0.0), ramp)
    along = min(max(t - ramp, 0.0), _CRUISES - ramp)
    down = min(max(t - _CRUISES, 0.0), ramp)
    return STOP_SPEED * (0.5 * up * up / ramp + along + down - 0.5 * down * down / ramp)


class _Log:
    """A run in which one hand goes a way [m] up and down, at most times at a headset's rate, and what the tool does."""

    def __init__(self, way: Callable[[float], float], noise: float) -> None:
        self._way = way
        samplings = {hand: HeadsetSampling(hand, 0, position_noise=noise) for hand in HANDS_AT_REST}
        self.hands = PlayedInput(self._pose, _buttons, samplings)
        self._t: list[float] = []
        self._tool: list[Array] = []
        self._asked: list[float] = []

    def take(self, tick: Tick) -> None:
        """Keep a tick's hand and tool."""
        t = self.hands.hand_pose(HAND, tick.now).translation[2] - HANDS_AT_REST[HAND].translation[2]
        self._t.append(tick.t - _BEGINS)
        self._asked.append(t)
        self._tool.append(tick.tools[ARM].translation.copy())

    def tone(self, frequency: float) -> tuple[float, float]:
        """Delay [s] and gain [dB] of a tone."""
        t, asked, tool = self._from(_SETTLES)
        basis = np.stack((np.sin(2 * np.pi * frequency * t), np.cos(2 * np.pi * frequency * t), np.ones_like(t), t), 1)
        (hand_sin, hand_cos, *_), (tool_sin, tool_cos, *_) = (
            np.linalg.lstsq(basis, way, rcond=None)[0] for way in (asked, tool[:, 2])
        )
        turn = complex(hand_sin, hand_cos) / complex(tool_sin, tool_cos)
        delay = (math.atan2(turn.imag, turn.real) % (2.0 * math.pi)) / (2.0 * math.pi * frequency)
        return delay, -20.0 * math.log10(abs(turn))

    def noise(self) -> float:
        """RMS about the mean, of the worst axis [m]."""
        _, _, tool = self._from(1.0)
        return float(tool.std(axis=0).max())

    def stop(self) -> tuple[float, float]:
        """When the tool is within 2 mm of its rest for good, after the hand's [s], and how far it went beyond [m]."""
        t, _, tool = self._from(0.0)
        ahead = tool[:, 2] - tool[-1, 2]
        late = t[np.abs(ahead) > 2e-3]
        return float(late[-1]) - (_CRUISES + STOP_TIME), max(float(ahead.max()), 0.0)

    def _from(self, begin: float) -> tuple[Array, Array, Array]:
        t = np.array(self._t)
        chosen = t >= begin
        return t[chosen], np.array(self._asked)[chosen], np.array(self._tool)[chosen]

    def _pose(self, hand: str, t: float) -> pin.SE3:
        home = HANDS_AT_REST[hand]
        way = self._way(t - _BEGINS) if hand == HAND and t >= _BEGINS else 0.0
        return pin.SE3(home.rotation, home.translation + np.array([0.0, 0.0, way]))


def _buttons(hand: str, t: float) -> HandInputs:
    return HandInputs(button_lower=_PRESSED[0] <= t < _PRESSED[1])
