"""Whether a camera's pictures came in time, can be seen, and move when the arms do."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.optimize import nnls

from q2r2_control.judging.episode import Episode
from q2r2_control.judging.pictures import Pictures
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Flags

_DARK = 8.0  # mean brightness of a black picture, of 255
_PLAIN = 1.0  # standard deviation of the brightness of a picture of one colour, of 255
_TRAVEL = 0.01  # of an arm's joints between two pictures, from which on the picture has to change [rad]
_ODD, _ODD_RATIO = 10.0, 3.0  # brightness by which a part of a damaged picture is unlike its neighbours, beyond theirs
_PARTS = (4, 6, 4, 8)  # of a view: rows of parts, rows in each; columns of parts, columns in each
_QUICK = 10.0  # rate from which on nothing passes a part of the picture between two pictures [Hz]
LARGEST_LAG = 0.4  # that is looked for [s]
_LAG_STEP = 0.02  # [s]
_IN_TIME = 0.1  # a lag up to this one is believed where it explains the motion nearly as well as the best one [s]
_NEARLY = 0.05  # of the motion in the pictures
_LEFT = 0.65  # of the motion that lags near zero leave unexplained, another lag leaves this share at most
_LEAST_FIT = 0.35  # of the motion in the pictures that the arms' explains
_FEWEST = 20  # pictures of which a lag or an arm can be told
_LEAST_TRAVEL = 0.5  # of an arm's joints in the whole episode, of which its camera can be told [rad]
_CORRELATES = 0.4  # the change of pictures with the arm that carries their camera, at least
_OTHER_ARM = 0.2  # by which the pictures of two swapped cameras correlate more with the other's arm, together
_STILL = 3.0  # change of brightness of what stands still, of 255
_MOSTLY, _HARDLY = 0.5, 0.35  # of what a camera sees stands still: a fixed camera, one that an arm carries


@dataclass(frozen=True, slots=True)
class CameraFigures:
    """One camera, until the run begins to end; None: there is nothing to tell it by."""

    arm: str | None  # the arm that carries the camera; None if none does
    pictures: int
    rate_share: float | None  # pictures by those that were due
    longest_gap_periods: float | None  # longest time without a picture, in the camera's periods
    frozen_share: float | None  # pictures like the one before, of those between which the arms moved
    black_share: float | None  # share of the pictures that are black or have one colour only
    bad_pictures: int  # number of pictures that are damaged, or have another size than the cell says
    lag_ms: float | None  # delay of the motion in the pictures behind the motion of the joints
    swapped_with: str | None  # the camera whose place it has


def camera_figures(episode: Episode) -> dict[str, CameraFigures]:
    """Figures of all cameras whose pictures can be looked at, by name."""
    if not episode.ticks.following.any():
        return {}
    looks = {name: _CameraLook(episode, name, pictures) for name, pictures in episode.pictures.items()}
    swapped = _swapped(looks)
    return {name: look.figures(swapped.get(name)) for name, look in looks.items()}


class _CameraLook:
    """Pictures of a camera beside the motion of the arms."""

    def __init__(self, episode: Episode, name: str, pictures: Pictures) -> None:
        camera = episode.config.cameras[name]
        t = episode.ticks.t[episode.ticks.following]
        self._start, self._end = float(t[0]), float(t[-1])
        self._rate = min(camera.rate, episode.config.nominal_rate_hz)  # a picture a tick, at most
        self._pictures = pictures.between(self._start, self._end, 0.0)
        self.fixed = camera.topic is None and camera.link is None
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
            rate_share=len(found.t) / due if due > 2.0 else None,
            longest_gap_periods=float(gaps.max() * self._rate) if due > 2.0 else None,
            frozen_share=self._frozen_share(),
            black_share=float(black[~found.damaged].mean()) if (~found.damaged).any() else None,
            bad_pictures=int((found.damaged | found.other_size | self._odd(views)).sum()),
            lag_ms=None if lag is None else 1e3 * lag,
            swapped_with=swapped_with,
        )

    def _frozen_share(self) -> float | None:
        """A camera on an arm sees that arm's motion for certain, any other that of some arm."""
        arms: Collection[str] = self._joints if self.arm is None else (self.arm,)
        moved = np.max([self.travel(arm) for arm in arms], axis=0) > _TRAVEL
        same = self._pictures.repeated[1:] | (self._change == 0.0)
        return float(same[moved].mean()) if moved.any() else None

    def _odd(self, views: Array) -> Flags:
        """Pictures with a part unlike before and after, which are like each other: what damaged pixels look like."""
        odd = np.zeros(len(views), dtype=bool)
        if len(views) > 2 and self._rate >= _QUICK:
            change, across = _by_part(np.diff(views, axis=0)), _by_part(views[2:] - views[:-2])
            odd[1:-1] = (np.minimum(change[:-1], change[1:]) > _ODD + _ODD_RATIO * across).any(axis=1)
        return odd

    def travel(self, arm: str, lag: float = 0.0) -> Array:
        """(k - 1,) by how much an arm's joints moved between two pictures, ``lag`` [s] before them [rad]."""
        if not len(self._t):
            return np.zeros(max(len(self._pictures.t) - 1, 0))
        q = np.stack([np.interp(self._pictures.t - lag, self._t, self._q[:, at]) for at in self._joints[arm]], axis=1)
        return np.asarray(np.linalg.norm(np.diff(q, axis=0), axis=1))

    def _lag(self) -> float | None:
        """The lag at which the arms' speeds explain the change of the pictures best, as c_1 s_1 + c_2 s_2 + c_0 >= 0.

        Other lags are believed only where they explain it clearly better than those near zero: an arm that goes to and
        fro has the same speed again later, and one that goes round looks faster where it is nearer to the camera.
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
        is_clear = near.max() < fits.max() - _NEARLY and 1.0 - fits.max() <= _LEFT * (1.0 - near.max())
        best = fits if is_clear else near
        return float(lags[np.argmax(best)]) if fits.max() >= _LEAST_FIT else None

    def correlation(self, arm: str) -> float:
        """Of the change of the pictures with the motion of an arm."""
        travel = self.travel(arm)
        if len(travel) < _FEWEST or not (travel.std() > 0.0 and self._change.std() > 0.0):
            return 0.0
        return float(np.corrcoef(travel, self._change)[0, 1])

    @property
    def moves(self) -> bool:
        """Whether the arm that carries it moves far enough to tell."""
        return self.arm is not None and float(self.travel(self.arm).sum()) > _LEAST_TRAVEL

    @property
    def still_share(self) -> float:
        """How much of what the camera sees stands still for nine tenths of the time."""
        views = self._pictures.views[~self._pictures.damaged].astype(np.float64)
        if len(views) < _FEWEST:
            return float("nan")
        away = np.percentile(np.abs(views - np.median(views, axis=0)), 90, axis=0)
        return float((away < _STILL).mean())


def _swapped(looks: dict[str, _CameraLook]) -> dict[str, str]:
    """Cameras whose pictures are those of another one, by name, with that other one.

    Two on different arms: the pictures of each go with the other's arm. A fixed one and one on an arm: hardly anything
    stands still before the former, most of it before the latter.
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
    """(k, parts) mean change of the parts of views (k, rows, columns)."""
    return np.asarray(np.abs(change).reshape(-1, *_PARTS).mean(axis=(2, 4)).reshape(len(change), -1))


def arm_of_link(robot: Robot, link: str) -> str | None:
    """The arm that moves a link; None if none does, or several do."""
    joints = {frame.parentJoint - 1 for frame in robot.model.frames if frame.name == link}
    arms = [name for name, arm in robot.arms.items() if joints & set(arm.joints.tolist())]
    return arms[0] if len(arms) == 1 else None
