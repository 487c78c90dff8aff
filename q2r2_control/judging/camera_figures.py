"""Check whether a camera's pictures came in time, are not black or damaged, and change when the arms move."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.optimize import nnls

from q2r2_control.cameras.camera_watch import MissingPictures
from q2r2_control.judging.episode import Episode
from q2r2_control.judging.pictures import Pictures
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Flags

# Brightness is from 0 to 255.
_DARK = 8.0  # A black picture has a mean brightness below this.
_PLAIN = 1.0  # A picture of one colour has a standard deviation of its brightness below this.
_TRAVEL = 0.01  # If the joints of an arm move more than this between two pictures, the picture has to change [rad].
# A part of a picture is damaged if its brightness differs too much from the pictures before and after. The limit is the
# first number, plus the second number times the difference between these two pictures.
_ODD, _ODD_RATIO = 10.0, 3.0
# A view is divided into 4 x 4 parts of 6 x 8 pixels. The numbers are in the order in which a view is reshaped: rows of
# parts, pixel rows of each part, columns of parts, pixel columns of each part.
_PARTS = (4, 6, 4, 8)
# Damaged parts are searched for only if the camera's rate is at least this [Hz]. At a lower rate, a moving body may be
# visible in a part of only one picture. This part would then wrongly count as damaged.
_QUICK = 10.0
LARGEST_LAG = 0.4  # The largest lag, of either sign, that is compared [s].
_LAG_STEP = 0.02  # The step between two lags that are compared [s].
_IN_TIME = 0.1  # A lag up to this is preferred if it explains the motion nearly as well as the best lag [s].
# A larger lag is chosen only if two conditions hold. The first condition: the share of the pictures' motion that the
# larger lag explains exceeds the share that the best small lag explains by more than this number.
_CLEARLY = 0.05
# The second condition: the share that the larger lag leaves unexplained, divided by the share that the best small lag
# leaves unexplained, is at most this number.
_UNEXPLAINED = 0.65
_LEAST_FIT = 0.35  # Least share of the pictures' motion that the arms' motion must explain, or else the lag is unknown.
_FEWEST = 20  # With fewer pictures, no lag is computed and no swap of cameras is found.
# A camera on an arm is compared with fixed cameras if the joints of its arm travel more than this in the episode [rad].
_LEAST_TRAVEL = 0.5
# Two cameras on different arms are swapped if each camera's pictures change with the motion of the other camera's arm.
_CORRELATES = 0.4  # Each camera's correlation with the other camera's arm must be larger than this.
# The sum of these two correlations must exceed, by more than this, the sum of the correlations with the cameras' own
# arms.
_OTHER_ARM = 0.2
_STILL = 3.0  # A pixel of a view stands still if its brightness changes by less than this.
# A camera seems to be fixed if the share of its view that stands still is larger than the first number. It seems to be
# on an arm if this share is smaller than the second number.
_MOSTLY, _HARDLY = 0.5, 0.35


@dataclass(frozen=True, slots=True)
class CameraFigures:
    """Figures of one camera. The end of the run, in which the arms come to rest, is left out.

    None means that a figure cannot be computed.
    """

    arm: str | None  # The arm that carries the camera; None if no arm does.
    pictures: int
    missing_pictures: int  # The number of pictures that were due and are missing.
    rate_share: float | None  # The number of pictures divided by the number that was due.
    longest_gap_periods: float | None  # The longest time without a picture, in the camera's periods.
    # The share of frozen pictures, which equal the picture before. A picture counts only if an arm has moved since the
    # picture before.
    frozen_share: float | None
    black_share: float | None  # The share of the pictures that are black or have one colour only.
    bad_pictures: int  # The number of pictures that are damaged, or have another size than the cell says.
    lag_ms: float | None  # The delay of the motion in the pictures behind the motion of the joints [ms].
    swapped_with: str | None  # The other camera, if these two cameras were swapped; None if not.


def camera_figures(episode: Episode) -> dict[str, CameraFigures]:
    """Return the figures of all cameras whose pictures can be read, by the camera's name.

    The result is empty if the file has no tick before the end of the run.
    """
    if not episode.ticks.following.any():
        return {}
    looks = {name: _CameraLook(episode, name, pictures) for name, pictures in episode.pictures.items()}
    swapped = _swapped(looks)
    return {name: look.figures(swapped.get(name)) for name, look in looks.items()}


class _CameraLook:
    """Compares the k pictures of a camera with the motion of the arms."""

    def __init__(self, episode: Episode, name: str, pictures: Pictures) -> None:
        camera = episode.config.cameras[name]
        t = episode.ticks.t[episode.ticks.following]
        self._start, self._end = float(t[0]), float(t[-1])
        self._rate = min(camera.rate, episode.config.nominal_rate_hz)  # There is at most one picture per tick.
        self._pictures = pictures.between(self._start, self._end, 0.0)
        # It is not known whether a real camera without a link is fixed, so it does not count as fixed.
        self.fixed = camera.is_simulated and camera.link is None
        self.arm = None if camera.link is None else arm_of_link(episode.robot, camera.link)
        measured = np.isfinite(episode.frames.q).all(axis=1)
        self._t, self._q = episode.frame_t[measured], episode.frames.q[measured]
        self._joints = {arm: joints.joints for arm, joints in episode.robot.arms.items()}
        views = self._pictures.views.astype(np.float64)
        self._change = np.abs(np.diff(views, axis=0)).mean(axis=(1, 2)) if len(views) else np.empty(0)  # (k - 1,)

    def figures(self, swapped_with: str | None) -> CameraFigures:
        found, due = self._pictures, (self._end - self._start) * self._rate
        views = found.views.astype(np.float64)
        black = (views.mean(axis=(1, 2)) < _DARK) | (views.std(axis=(1, 2)) < _PLAIN)
        gaps = np.diff(np.concatenate(([self._start], found.t, [self._end])))
        lag = self._lag()
        return CameraFigures(
            arm=self.arm,
            pictures=len(found.t),
            missing_pictures=self._missing(),
            rate_share=len(found.t) / due if due > 2.0 else None,
            longest_gap_periods=float(gaps.max() * self._rate) if due > 2.0 else None,
            frozen_share=self._frozen_share(),
            black_share=float(black[~found.damaged].mean()) if (~found.damaged).any() else None,
            bad_pictures=int((found.damaged | found.other_size | self._odd(views)).sum()),
            lag_ms=None if lag is None else 1e3 * lag,
            swapped_with=swapped_with,
        )

    def _missing(self) -> int:
        missing = MissingPictures(self._start, self._rate)
        for t in self._pictures.t:
            missing.add(float(t))
        missing.finish(self._end)
        return missing.count

    def _frozen_share(self) -> float | None:
        """Return the share of pictures that equal the picture before them, although an arm moved between the two.

        The arm is the arm that carries the camera, or any arm if no arm carries it. Return None if no arm moved.
        """
        arms: Collection[str] = self._joints if self.arm is None else (self.arm,)
        moved = np.max([self.travel(arm) for arm in arms], axis=0) > _TRAVEL
        same = self._pictures.repeated[1:] | (self._change == 0.0)
        return float(same[moved].mean()) if moved.any() else None

    def _odd(self, views: Array) -> Flags:
        """Return which pictures (k,) seem damaged.

        One part of such a picture differs from the pictures before and after, although these two are alike.
        """
        odd = np.zeros(len(views), dtype=bool)
        if len(views) > 2 and self._rate >= _QUICK:
            change, across = _by_part(np.diff(views, axis=0)), _by_part(views[2:] - views[:-2])
            odd[1:-1] = (np.minimum(change[:-1], change[1:]) > _ODD + _ODD_RATIO * across).any(axis=1)
        return odd

    def travel(self, arm: str, lag: float = 0.0) -> Array:
        """Return how far an arm's joints moved (k - 1,) from each picture to the next, as a Euclidean norm [rad].

        A picture is assumed to show the arm ``lag`` [s] before the time of the picture.
        """
        if not len(self._t):
            return np.zeros(max(len(self._pictures.t) - 1, 0))
        q = np.stack([np.interp(self._pictures.t - lag, self._t, self._q[:, at]) for at in self._joints[arm]], axis=1)
        return np.asarray(np.linalg.norm(np.diff(q, axis=0), axis=1))

    def _lag(self) -> float | None:
        """Return the lag [s] at which the arms' speeds s explain the change of the pictures best.

        The model is c_1 s_1 + c_2 s_2 + c_0, with all c >= 0. A lag that is not near zero counts only if it explains
        the change clearly better than the lags near zero. The reason is that two kinds of motion make a wrong lag fit,
        too. An arm that moves to and fro has the same speed again later. An arm that moves in a circle looks faster
        when it is near the camera.

        Return None if there are too few pictures, if they do not change, or if the best lag explains too little.
        """
        change, lags = self._change, np.arange(-LARGEST_LAG, LARGEST_LAG + _LAG_STEP, _LAG_STEP)
        energy = float(np.sum((change - change.mean()) ** 2)) if len(change) >= _FEWEST else 0.0
        if energy <= 0.0:
            return None
        fits = np.empty(len(lags))
        for index, lag in enumerate(lags):
            speeds = np.stack([*(self.travel(arm, lag) for arm in self._joints), np.ones(len(change))], axis=1)
            fits[index] = 1.0 - nnls(speeds, change)[1] ** 2 / energy
        near = np.where(np.abs(lags) <= _IN_TIME, fits, -np.inf)
        is_clear = near.max() < fits.max() - _CLEARLY and 1.0 - fits.max() <= _UNEXPLAINED * (1.0 - near.max())
        best = fits if is_clear else near
        return float(lags[np.argmax(best)]) if fits.max() >= _LEAST_FIT else None

    def correlation(self, arm: str) -> float:
        """Return the correlation of the change of the pictures with the motion of an arm.

        The result is 0 if there are too few pictures, or if the change or the motion is constant.
        """
        travel = self.travel(arm)
        if len(travel) < _FEWEST or not (travel.std() > 0.0 and self._change.std() > 0.0):
            return 0.0
        return float(np.corrcoef(travel, self._change)[0, 1])

    @property
    def moves(self) -> bool:
        """Return whether an arm carries the camera and moves far enough for a comparison with a fixed camera."""
        return self.arm is not None and float(self.travel(self.arm).sum()) > _LEAST_TRAVEL

    @property
    def still_share(self) -> float:
        """Return the share of the view's pixels that stand still for nine tenths of the time.

        The result is NaN if there are too few pictures.
        """
        views = self._pictures.views[~self._pictures.damaged].astype(np.float64)
        if len(views) < _FEWEST:
            return float("nan")
        away = np.percentile(np.abs(views - np.median(views, axis=0)), 90, axis=0)
        return float((away < _STILL).mean())


def _swapped(looks: dict[str, _CameraLook]) -> dict[str, str]:
    """Return the name of each camera that was swapped, with the name of the other camera.

    Two cameras on different arms are swapped if each camera's pictures change with the motion of the other camera's
    arm. A fixed camera and a camera on an arm are swapped if two conditions hold: Hardly anything stands still in the
    view of the fixed camera. Most things stand still in the view of the camera on the arm, although the arm moves.
    """
    found: dict[str, str] = {}
    for (one, first), (two, second) in combinations(looks.items(), 2):
        if first.arm is not None and second.arm is not None and first.arm != second.arm:
            own = first.correlation(first.arm), second.correlation(second.arm)
            other = first.correlation(second.arm), second.correlation(first.arm)
            swapped = min(other) > _CORRELATES and sum(other) > sum(own) + _OTHER_ARM
        elif first.fixed != second.fixed:
            fixed, carried = (first, second) if first.fixed else (second, first)
            swapped = carried.moves and fixed.still_share < _HARDLY and carried.still_share > _MOSTLY
        else:
            swapped = False
        if swapped:
            found |= {one: two, two: one}
    return found


def _by_part(change: Array) -> Array:
    """Return the mean absolute change (k, parts) in each part of a view, from the ``change`` (k, rows, columns)."""
    return np.asarray(np.abs(change).reshape(-1, *_PARTS).mean(axis=(2, 4)).reshape(len(change), -1))


def arm_of_link(robot: Robot, link: str) -> str | None:
    """Return the arm that moves a link; None if no arm or several arms move it."""
    joints = {frame.parentJoint - 1 for frame in robot.model.frames if frame.name == link}
    arms = [name for name, arm in robot.arms.items() if joints & set(arm.joints.tolist())]
    return arms[0] if len(arms) == 1 else None
