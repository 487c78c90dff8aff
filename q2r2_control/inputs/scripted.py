"""Scripted hands: ideal or human-like motions with button presses, which are the same in every run.

A motion is a displacement from the pose that the hand has at the start. All motions except assembly works are written
for the left hand, and the right hand moves as its mirror image. The axes are x forwards, y to the left, and z up.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

from q2r2_control.config.cell import Config
from q2r2_control.config.teleop import PRECISION_SCALE
from q2r2_control.errors import ConfigError
from q2r2_control.inputs.assembly import WORKS
from q2r2_control.inputs.played import EvenSampling, HeadsetSampling, PlayedInput, SampleTiming
from q2r2_control.inputs.way_points import HOME, HandWork, WayPoint, WayPoints, minimum_jerk
from q2r2_control.robot.compose import compose
from q2r2_control.types import SIDES, Array, HandInputs

PRESS_DURATION = 0.15  # Time for which a button is pressed [s].
FIRST_PRESS = 0.6  # Time at which the lower buttons engage both arms [s].
START = 1.2  # Time at which the motion starts [s].
# Time from the end of the work to the press that pauses both arms, and from this press to the end of the run [s].
_LAST_PRESS, _REST = 0.4, 0.6
_RAMP = 1.0  # Time for which a periodic motion accelerates at its start [s].

# (t [s], frequency [Hz]) -> displacement (3,) [m] and rotation vector (3,) [rad] of a hand.
Path = Callable[[float, float], tuple[Array, Array]]


@dataclass(frozen=True)
class HandTrajectory:
    """The motion of both hands over time.

    ``left`` and ``right`` map a time [s] and a frequency [Hz] to the displacement (3,) [m] and the rotation vector (3,)
    [rad] of a hand since its start. The axes are x forwards, y to the left, and z up. All times begin with the first
    poll.
    """

    left: Path
    right: Path | None = None  # None if the right hand moves as the mirror image of the left hand.
    upper_presses: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # Each hand's times of presses [s].
    lower_presses: tuple[float, ...] = (FIRST_PRESS,)  # Times of presses by both hands [s].
    duration: float | None = None  # [s]; None if the motion has no end.
    steps: tuple[tuple[float, str], ...] = ()  # Start of each step [s], and the step in words.
    grips: tuple[float, ...] = ()  # Times of taps on the left grip [s].
    precise: tuple[tuple[float, float], ...] = ()  # Start and end of each time span with both sticks pushed up [s].
    lost: tuple[float, float] = (math.inf, math.inf)  # Start and end of the time without tracking of the hands [s].

    def displacement(self, hand: str, t: float, frequency: float) -> tuple[Array, Array]:
        """Return the displacement (3,) [m] and the rotation vector (3,) [rad] of ``hand`` at ``t`` [s]."""
        if hand == "left":
            return self.left(t, frequency)
        if self.right is not None:
            return self.right(t, frequency)
        displacement, turn = self.left(t, frequency)
        return displacement * (1.0, -1.0, 1.0), turn * (-1.0, 1.0, -1.0)

    def inputs(self, hand: str, t: float) -> HandInputs:
        """Return the buttons of ``hand`` at ``t`` [s]. The index trigger is held while the gripper has to be closed."""
        upper = self.upper_presses.get(hand, ())
        grips = self.grips if hand == "left" else ()
        pressed = [
            any(press <= t < press + PRESS_DURATION for press in presses)
            for presses in (upper, self.lower_presses, grips)
        ]
        closed = sum(press <= t for press in upper) % 2
        return HandInputs(
            button_upper=pressed[0],
            button_lower=pressed[1],
            press_index=float(closed),
            press_middle=float(pressed[2]),
            thumb_stick_vertical=float(any(begins <= t < ends for begins, ends in self.precise)),
        )


def _phase(t: float, frequency: float) -> float:
    """Return the phase angle of a periodic motion at ``t`` [rad]. Its speed rises smoothly at the start."""
    elapsed = max(t - START, 0.0)
    if elapsed < _RAMP:
        return math.pi * frequency * (elapsed - _RAMP / math.pi * math.sin(math.pi * elapsed / _RAMP))
    return 2.0 * math.pi * frequency * (elapsed - _RAMP / 2.0)


def _circle(t: float, frequency: float) -> tuple[Array, Array]:
    """Return the hand's displacement at ``t`` on a circle of radius 0.1 m, as in Quest2ROS2's SimulationInput.

    The circle lies in the plane of y and z, and the start is its lowest point.
    """
    phase = _phase(t, frequency)
    return np.array([0.0, 0.1 * math.sin(phase), 0.1 * (1.0 - math.cos(phase))]), np.zeros(3)


def _line(t: float, frequency: float) -> tuple[Array, Array]:
    """Return the hand's displacement at ``t`` on a straight line of 0.15 m forwards and up, and back again."""
    distance = 0.15 * (1.0 - math.cos(_phase(t, frequency))) / 2.0
    return distance * np.array([0.6, 0.0, 0.8]), np.zeros(3)


def _rotate(t: float, frequency: float) -> tuple[Array, Array]:
    """Return the hand's displacement at ``t`` in a motion that turns the hand by 30 degrees and back.

    The hand turns about x, y and z one after the other. During this motion, it is 0.05 m above its start.
    """
    phase = _phase(t, frequency)
    turn = np.zeros(3)
    turn[int(phase / (2.0 * math.pi)) % 3] = math.radians(30.0) * (1.0 - math.cos(phase)) / 2.0
    lift = 0.05 * minimum_jerk((t - START) / _RAMP)
    return np.array([0.0, 0.0, lift]), turn


def in_sequence(works: Sequence[tuple[str, HandWork]]) -> HandTrajectory:
    """Return the motion of hands that do several named works one after the other, and then pause the arms."""
    homes: dict[str, WayPoint] = {hand: (0.0, *HOME[hand], 0.0, 0.0) for hand in SIDES}
    points = {hand: [home] for hand, home in homes.items()}
    presses: dict[str, list[float]] = {hand: [] for hand in SIDES}
    begins, steps = START, [(0.0, "the hands rest")]
    grips, engages, precise = list[float](), list[float](), list[tuple[float, float]]()
    for name, work in works:
        steps += [(begins + t, f"{name}: {words}") for t, words in work.steps]
        for hand, home in homes.items():
            added = [(begins + point[0], *point[1:]) for point in (home, *work.tools.get(hand, ()))]
            points[hand] += [point for point in added if point[0] > points[hand][-1][0]]
            presses[hand] += [begins + t for t in work.presses.get(hand, ())]
        grips += [begins + t for t in work.grips]
        engages += [begins + t for t in work.engages]
        precise += [(begins + first, begins + last) for first, last in work.precise]
        begins += work.duration
    return HandTrajectory(
        left=_from_home(points["left"], "left", precise),
        right=_from_home(points["right"], "right", precise),
        upper_presses={hand: tuple(times) for hand, times in presses.items()},
        lower_presses=(FIRST_PRESS, *engages, begins + _LAST_PRESS),
        duration=begins + _LAST_PRESS + _REST,
        steps=tuple(steps),
        grips=tuple(grips),
        precise=tuple(precise),
    )


def _from_home(points: Sequence[WayPoint], hand: str, precise: Sequence[tuple[float, float]]) -> Path:
    """Return the motion of ``hand`` that moves its tool through ``points``.

    In the time spans ``precise``, the hand moves its tool with precision.
    """
    tool, home = WayPoints(points), np.array(HOME[hand])

    def displacement(t: float, frequency: float) -> tuple[Array, Array]:
        place, turn = tool.at(t)
        # With precision, the tool moves only by a fraction of the hand's motion. The hand therefore moves farther than
        # the tool, and keeps this offset afterwards.
        fine = sum(
            (tool.at(min(max(t, begins), ends))[0] - tool.at(begins)[0] for begins, ends in precise), np.zeros(3)
        )
        return place - home + (1.0 / PRECISION_SCALE - 1.0) * fine, turn

    return displacement


TRAJECTORIES: Mapping[str, HandTrajectory] = {
    "circle": HandTrajectory(_circle),
    "line": HandTrajectory(_line),
    "rotate": HandTrajectory(_rotate),
    **{name: in_sequence([(name, work)]) for name, work in WORKS.items()},
}


def place_of(seed: int, spread: float) -> tuple[float, float]:
    """Return a random shift of all tasks' parts along x and y [m], each between -``spread`` and ``spread``."""
    x, y = np.random.default_rng([seed, _PLACES]).uniform(-spread, spread, 2).tolist()
    return x, y


def trajectory_named(name: str, place: tuple[float, float] | None = None) -> HandTrajectory:
    """Return one of :data:`TRAJECTORIES`, or several works, such as ``handover+stack``.

    Args:
        name: The trajectory, or works joined by ``+``.
        place: The shift of all parts along x and y [m]; None if they are not shifted.

    Raises:
        ConfigError: If the name is unknown, or if a place is given for a motion without parts.
    """
    works = name.split("+")
    if place is not None and all(work in WORKS for work in works):
        return in_sequence([(work, WORKS[work].moved(*place)) for work in works])
    if place is not None:
        raise ConfigError(f"scripted trajectory {name!r:.60}: has no parts to spread; allowed: {', '.join(WORKS)}")
    if name in TRAJECTORIES:
        return TRAJECTORIES[name]
    if not all(work in WORKS for work in works):
        allowed = f"{', '.join(TRAJECTORIES)}, and {', '.join(WORKS)} joined by +"
        raise ConfigError(f"scripted trajectory {name!r:.60}: allowed are {allowed}")
    return in_sequence([(work, WORKS[work]) for work in works])


_PLACES = 7  # Second seed. It makes the shifts independent of other random numbers with the same first seed.
_PACE = 1.25  # Speed of hasty hands, as a multiple of the speed in the trajectory.
_HESITATIONS, _HESITATES = 3, 0.4  # Number of hesitations, and the duration of each [s].
# The headset loses the hands once. These are the times from this loss [s] until the headset sees the hands again, until
# the hands engage the arms, until they begin to carry again, and until they continue the work.
_LOST, _ENGAGES, _CARRIES, _GOES_ON = 1.0, 1.3, 1.6, 2.1
# The headset loses the hands when a fraction of the work in this range is done. No tool presses on a part by then.
_EARLY = (0.1, 0.45)
_NO_PRESS = (0.3, 0.6)  # Hands do not hesitate within these times before and after a press [s].


def hurried(work: HandTrajectory, seed: int) -> HandTrajectory:
    """Return the same work, done by hasty hands.

    Hasty hands are faster and hesitate, and the headset loses them once for a second. After the loss, the hands wait
    until the headset sees them again, engage both arms again, and go on.
    """
    assert work.duration is not None
    random, presses = np.random.default_rng([seed, len(SIDES)]), [*work.lower_presses, *work.grips]
    presses = sorted(presses + [press for times in work.upper_presses.values() for press in times])

    def stop(fraction: float) -> float:
        at = fraction * (work.duration or 0.0)
        for press in presses:
            if press - _NO_PRESS[0] < at < press + _NO_PRESS[1]:
                at = press + _NO_PRESS[1]
        return at

    lost = stop(random.uniform(*_EARLY))
    stops = [(stop(fraction), _HESITATES) for fraction in random.uniform(0.1, 0.9, _HESITATIONS)]
    played, written, t = [0.0], [0.0], 0.0
    for at, pause in sorted([*stops, (lost, _GOES_ON), (work.duration, 0.0)]):
        t += (at - written[-1]) / _PACE
        played += [t, t + pause]
        written += [at, at]
        t += pause
    seen = played[written.index(lost)]

    def then(times: Sequence[float]) -> tuple[float, ...]:
        return tuple(np.interp(times, written, played).tolist())

    def slowed(path: Path) -> Path:
        return lambda t, frequency: path(float(np.interp(t, played, written)), frequency)

    carries = sum(grip < lost for grip in work.grips) % 2
    return HandTrajectory(
        left=slowed(work.left),
        right=None if work.right is None else slowed(work.right),
        upper_presses={hand: then(times) for hand, times in work.upper_presses.items()},
        lower_presses=(*then(work.lower_presses), seen + _ENGAGES),
        duration=t,
        steps=tuple(zip(then([at for at, _ in work.steps]), [words for _, words in work.steps], strict=True)),
        grips=(*then(work.grips), *[seen + _CARRIES] * carries),
        precise=tuple((then([begins])[0], then([ends])[0]) for begins, ends in work.precise),
        lost=(seen, seen + _LOST),
    )


# Poses of an operator's hands at the start, in the input's frame. Arms follow only the motion from these poses.
HANDS_AT_REST = {
    "left": pin.SE3(pin.rpy.rpyToMatrix(0.1, -0.2, 0.3), np.array([0.35, 0.25, 1.1])),
    "right": pin.SE3(pin.rpy.rpyToMatrix(-0.1, -0.2, -0.3), np.array([0.35, -0.25, 1.1])),
}
_DROPOUT_PROBABILITY = 0.005  # Probability that a sample is lost.
_DIFFERENCE = 1e-4  # Half the time step of a central difference of the ideal pose [s].
DEFAULT_TRAJECTORY = "meet"
# Length of an iiwa 7 from its first joint to its last joint. The motions are written for an arm of this length [m].
_FULL_LENGTH = 1.12


class ScriptedInput(PlayedInput):
    """Plays a trajectory of both hands, from the first poll on. Implements :class:`Input`.

    Args:
        trajectory: A trajectory, or its name.
        hands: The hands that have samples.
        human: Sample the hands as :class:`HeadsetSampling` does, with tremor and dropouts.
        seed: Seed of all random numbers.
        rate_hz: Constant rate of the samples if neither ``human`` nor ``shaky`` is True [Hz].
        frequency_hz: Repetitions of circle, line and rotate per second [Hz].
        jitter: Greatest delay of each evenly sampled pose [s].
        scale: Factor of all distances of the trajectory. Rotations are not scaled.
        shaky: Sample the hands as with ``human``, but with more tremor. The hands are hasty; see :func:`hurried`.
        spread: Greatest shift of the parts of a task [m]; see :func:`place_of`.

    Raises:
        ConfigError: For an unknown trajectory or hand, and for a number that is not allowed.
    """

    options = ("trajectory", "human", "seed", "fast", "shaky", "spread")
    simulated = True
    executable = "SimulationInput"

    def __init__(
        self,
        trajectory: str | HandTrajectory,
        hands: Sequence[str] = SIDES,
        human: bool = False,
        seed: int = 0,
        rate_hz: float = 75.0,
        frequency_hz: float = 0.25,
        jitter: float = 0.0,
        scale: float = 1.0,
        shaky: bool = False,
        spread: float = 0.0,
    ) -> None:
        for hand in hands:
            if hand not in SIDES:
                raise ConfigError(f"scripted hand {hand!r}: allowed are {', '.join(SIDES)}")
        limits = (("rate_hz", rate_hz, 2000.0), ("frequency_hz", frequency_hz, 2.0), ("scale", scale, 1.0))
        for name, value, limit in limits:
            if not 0.0 < value <= limit:
                raise ConfigError(f"scripted input: {name} = {value!r}: allowed is above 0 and up to {limit:g}")
        if not 0.0 <= jitter <= 0.5 / rate_hz:
            raise ConfigError(
                f"scripted input: jitter = {jitter!r}: allowed is 0 .. {0.5 / rate_hz:.3g}, half a sample"
            )
        place = place_of(seed, spread) if spread else None
        self._trajectory = trajectory_named(trajectory, place) if isinstance(trajectory, str) else trajectory
        if shaky and self._trajectory.duration is not None:
            self._trajectory = hurried(self._trajectory, seed)
        self._frequency, self._scale, lost = frequency_hz, scale, self._trajectory.lost

        def sampling(hand: str) -> SampleTiming:
            if not (human or shaky):
                return EvenSampling(rate_hz, jitter, (seed, SIDES.index(hand)))
            often = _DROPOUT_PROBABILITY
            return HeadsetSampling(hand, seed, tremor=True, dropout_probability=often, shaky=shaky, lost=lost)

        super().__init__(self._ideal, self._trajectory.inputs, {hand: sampling(hand) for hand in hands})

    @classmethod
    def from_config(
        cls,
        config: Config,
        trajectory: str = DEFAULT_TRAJECTORY,
        human: bool = False,
        seed: int = 0,
        fast: bool = False,
        shaky: bool = False,
        spread: float = 0.0,
    ) -> ScriptedInput:
        """Make an input whose motions are scaled to the shortest arm of the cell, if it is shorter than an iiwa 7.

        ``fast`` changes nothing: the samples depend only on the times of the polls, which may be simulated or real.
        """
        shortest = min(compose(config).arm_lengths().values())
        scale = min(shortest / _FULL_LENGTH, 1.0)
        return cls(trajectory, human=human, seed=seed, shaky=shaky, scale=scale, spread=spread)

    def hand_twist(self, hand: str, t: float) -> pin.Motion:
        """Return the ideal velocity of ``hand`` at ``t`` [s], in the axes of its poses [m/s, rad/s]."""
        t -= self._origin or 0.0  # Times that count from 1970 would make the differences below inexact.
        before, after = (self._ideal(hand, t + step) for step in (-_DIFFERENCE, _DIFFERENCE))
        linear = (after.translation - before.translation) / (2.0 * _DIFFERENCE)
        return pin.Motion(linear, pin.log3(after.rotation @ before.rotation.T) / (2.0 * _DIFFERENCE))

    def _ideal(self, hand: str, t: float) -> pin.SE3:
        displacement, turn = self._trajectory.displacement(hand, t, self._frequency)
        home = HANDS_AT_REST[hand]
        return pin.SE3(pin.exp3(turn) @ home.rotation, home.translation + self._scale * displacement)
