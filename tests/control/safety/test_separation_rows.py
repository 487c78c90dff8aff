from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.geometry.collision import CollisionData, update_placements
from q2r2_control.control.geometry.pair_distance import measure
from q2r2_control.control.kernel_model import KernelModel, kernel_model_of
from q2r2_control.control.safety.safety_data import INSTANTS
from q2r2_control.control.safety.safety_filter import measure_pairs
from q2r2_control.control.safety.separation_rows import write_separation_rows
from q2r2_control.control.safety.speed_bound import update_body_velocities
from q2r2_control.control.safety.stop_rollout import TOGETHER, write_stop
from q2r2_control.types import Array
from tests.control.cells import (
    NAMES,
    CellArrays,
    behind,
    cell,
    distances,
    kernel_model,
    placed,
    random_posture,
    reused_data,
)

APPROACH = kernel_model("dual_iiwa7").safety.approach
STOP_DISTANCE = float(APPROACH.stop_distance[0])
H = 0.001
SAME_DISTANCE = 0.002  # An instant has a row if its distance exceeds the stop's least distance by at most this [m].
SAME_POINT = 0.005  # A segment's end has its own row if it is farther than this from the closest point [m].
CLEAR = 2e-5  # If a condition holds or fails by less than this, the test does not check the row [m].


class Seen:
    """The measured distances and the written rows in one state. In the known stop, all joints stop together."""

    def __init__(self, name: str, q: Array, v: Array, kernels: KernelModel | None = None) -> None:
        model, data = (kernels or kernel_model(name)).safety, reused_data(name, q, v).safety
        update_body_velocities(model.collision, data.collision, v, data.velocities)
        write_stop(model, q, v, TOGETHER, data.certified)
        self.closest = measure_pairs(model, data)
        write_separation_rows(model, data, H)
        self.distance, self.near, rows = data.distance, data.near, data.rows
        used = int(rows.used[0])
        self.matrix, self.lower, self.pair = rows.matrix[:used], rows.lower[:used], rows.pair[:used]
        np.testing.assert_allclose(np.linalg.norm(self.matrix, axis=1), 1.0, rtol=0, atol=1e-9)
        self.stops_after = np.abs(v) / data.certified  # (nv,) Time until each joint is at rest [s].
        self.duration = float(np.max(self.stops_after))
        self.angular, self.approach = data.velocities.angular, model.approach
        self.acceleration = model.limits.acceleration


def _state(name: str, seed: int, speed: float) -> tuple[Array, Array]:
    random, robot = np.random.default_rng(seed), cell(name).robot
    return random_posture(robot, random), speed * random.uniform(-robot.velocity_limit, robot.velocity_limit)


SEEDS = st.integers(0, 2**32 - 1)


@given(seed=SEEDS, name=st.sampled_from(NAMES), speed=st.floats(0.0, 1.0))
@settings(derandomize=True, max_examples=80, deadline=None)
def test_distances_of_near_pairs_are_exact_and_other_distances_are_never_too_large(
    seed: int, name: str, speed: float
) -> None:
    q, v = _state(name, seed, speed)
    seen, exact = Seen(name, q, v), distances(cell(name), q[None])[0]
    assert (seen.distance <= exact + 1e-12).all()
    matters = exact <= STOP_DISTANCE
    np.testing.assert_allclose(seen.distance[matters], exact[matters], rtol=0, atol=1e-12)
    assert seen.distance[seen.closest] == pytest.approx(exact.min(), abs=1e-12)
    # For far pairs only a lower bound of the distance is computed. If this bound were below the stop distance, the stop
    # certificate would count the pair as too close.
    assert (seen.distance[~matters] > STOP_DISTANCE).all()


@given(seed=SEEDS, name=st.sampled_from(NAMES), speed=st.floats(0.05, 1.0))
@settings(derandomize=True, max_examples=80, deadline=None)
def test_a_pair_that_approaches_fast_counts_as_near_before_its_rows_become_necessary(
    seed: int, name: str, speed: float
) -> None:
    q, v = _state(name, seed, speed)
    seen, exact = Seen(name, q, v), distances(cell(name), q[None])[0]
    before, after = distances(cell(name), q + 1e-6 * np.array([[-1.0], [1.0]]) * v)
    closing = np.maximum((before - after) / 2e-6, 0.0)
    in_time = STOP_DISTANCE + (2.0 / APPROACH.gain + 0.5 * seen.duration) * closing
    assert seen.near[exact < in_time - 1e-4].all()


@given(seed=SEEDS, name=st.sampled_from(NAMES))
@settings(derandomize=True, max_examples=40, deadline=None)
def test_for_arms_at_rest_a_pair_counts_as_near_exactly_if_one_step_can_make_its_rows_necessary(
    seed: int, name: str
) -> None:
    q, v = _state(name, seed, 0.0)
    seen, exact, model = Seen(name, q, v), distances(cell(name), q[None])[0], kernel_model(name).safety
    approach, surge = model.approach, float(np.max(model.limits.acceleration)) * model.limits.longest_step
    reach = (2.0 / approach.gain[0]) * model.collision.pairs.leverage * surge
    needed = approach.stop_distance + approach.contact_zone + reach
    assert seen.near[exact < needed - 1e-6].all()
    assert not seen.near[exact > needed + 1e-6].any()


def _gradient(arrays: CellArrays, q: Array, p: int) -> Array:
    step = 1e-6 * np.eye(len(q))
    after, before = distances(arrays, np.concatenate([q + step, q - step]), pairs=np.array([p]))[:, 0].reshape(2, -1)
    return np.asarray((after - before) / 2e-6)


@given(seed=SEEDS, name=st.sampled_from(NAMES))
@settings(derandomize=True, max_examples=80, deadline=None)
def test_every_pair_that_is_too_close_gets_a_row_that_moves_its_bodies_apart_at_bounded_speed(
    seed: int, name: str
) -> None:
    q, v = _state(name, seed, 0.0)
    seen, exact = Seen(name, q, v), distances(cell(name), q[None])[0]
    for p in np.flatnonzero(exact < STOP_DISTANCE - 1e-3).tolist():
        first = np.flatnonzero(seen.pair == p)[0]
        assert seen.lower[first] > 0.0
        if exact[p] > -0.03:
            opening = seen.lower[first] * np.linalg.norm(_gradient(cell(name), q, p))
            assert opening <= APPROACH.recovery_speed * (1 + 1e-4)


def _least_free(name: str, q: Array, v: Array, duration: float, p: int) -> float:
    """Return B [m], the least free distance of a pair during a stop from (q, v) that is straight in joint space."""
    way = np.linspace(0.0, 0.5 * duration, 33)[:, None] * v
    return float(distances(cell(name), q + way, pairs=np.array([p])).min()) - STOP_DISTANCE


@pytest.mark.parametrize("name", NAMES)
def test_velocities_that_satisfy_the_rows_reduce_the_free_distance_no_faster_than_the_gain_allows(name: str) -> None:
    """The rows are not too strict either: velocities that violate them reduce the distance faster than allowed."""
    random, kept, broken = np.random.default_rng(5), 0, 0
    for seed in range(150):
        q, v = _state(name, seed, 0.4)
        seen = Seen(name, q, v)
        change = 10.0 * H * random.uniform(-1.0, 1.0, 14)
        for p in set(seen.pair.tolist()):
            if seen.distance[p] < STOP_DISTANCE:
                continue
            rows = np.flatnonzero(seen.pair == p)
            before = _least_free(name, q, v, seen.duration, p)
            if before < 0.0:
                continue
            after = _least_free(name, q + 0.5 * H * (2 * v + change), v + change, seen.duration, p)
            excess = (after - before) + APPROACH.gain * H * before
            meets = (seen.matrix[rows] @ (v + change) >= seen.lower[rows]).all()
            if meets:
                assert excess > -2e-5
                kept += 1
            else:
                broken += bool(excess < 2e-5)
                assert excess < 2e-4
    assert kept > 10
    assert broken > 10


class _Candidate(NamedTuple):
    """A row that the documented rule describes, and the margin with which the conditions for writing it hold."""

    row: Array  # (nv,) Unit vector.
    lower: float  # [rad/s]
    margin: float  # The smallest margin of the conditions [m]. If it is negative, the row is not written.


class _Rule:
    """Computes the rows of one pair of capsules with the formulas in the docstring of separation_rows.py."""

    def __init__(self, name: str, seen: Seen, q: Array, v: Array, p: int) -> None:
        self._cell, self._seen, self._q, self._v, self._p = cell(name), seen, q, v, p
        self._bodies = self._cell.pairs.first[p], self._cell.pairs.second[p]
        spins = seen.angular[self._cell.bodies.joint[list(self._bodies)]]
        look_ahead = 0.5 * seen.duration + 1.0 / float(seen.approach.gain[0])
        self._data = placed(self._cell, q)
        self._turned = float(np.linalg.norm(spins[0] - spins[1])) * look_ahead  # [rad]

    def candidates(self, straight: bool) -> Iterator[_Candidate]:
        """Yield the rows in the order in which they are written.

        If the paths of the pair are ``straight``, the end of the stop is computed from the gradient at its start.
        """
        whole, duration = self._distance, self._seen.duration
        instants = [i for i in INSTANTS if not straight or i in (INSTANTS[0], INSTANTS[-1])]
        moved = {i: self._moved(duration * i / INSTANTS[-1]) for i in instants}
        postures = {i: self._q if straight else self._q + moved[i] for i in instants}
        tangents = {i: moved[i] if straight else 0.0 * moved[i] for i in instants}
        gradient = self._gradient_of_whole(self._q)
        ahead = {i: whole(postures[i]) + float(gradient @ tangents[i]) for i in instants}
        least = min(ahead.values())
        for i in instants:
            t = duration * i / INSTANTS[-1]
            lever = max(t - 0.5 * t * t / duration, 0.5 * H) + 0.5 * H
            if ahead[i] > least + SAME_DISTANCE or (i > 0 and lever <= H):
                continue
            slope = self._gradient_of_whole(postures[i])
            first = self._candidate(whole(postures[i]), slope, tangents[i], lever, least, np.inf)
            yield first
            if first.margin < 0.0:
                continue
            closest = self._closest(postures[i])
            for body in (0, 1):
                for end in ("start", "end"):
                    distance = partial(self._end_distance, body, end)
                    apart = float(np.linalg.norm(self._end(body, end, postures[i]) - closest[body]))
                    near = whole(postures[i]) + self._turned * apart + SAME_POINT - distance(postures[i])
                    conditions = min(near, apart - SAME_POINT)
                    slope = self._gradient(distance, postures[i])
                    yield self._candidate(distance(postures[i]), slope, tangents[i], lever, least, conditions)

    def _candidate(
        self, distance: float, gradient: Array, tangent: Array, lever: float, least: float, margin: float
    ) -> _Candidate:
        approach, v = self._seen.approach, self._v
        gain, stop = float(approach.gain[0]), float(approach.stop_distance[self._p])
        rate = float(gradient @ v)
        free = distance + float(gradient @ tangent) - stop
        change = float(np.abs(gradient) @ self._seen.acceleration) * H * lever
        allowed = -gain * H * min(free, least - stop) - min(50.0 * H, 1.0) * max(free - least + stop, 0.0)
        slow, zone = float(approach.contact_speed[self._p]), float(approach.contact_zone[self._p])
        if slow < np.inf:
            allowed = max(allowed, -H * max(slow, gain * (free - zone)))
        size = float(np.linalg.norm(gradient))
        binds = allowed - (H * rate - change)
        return _Candidate(gradient / size, (rate + (allowed - H * rate) / lever) / size, min(margin, binds))

    def _moved(self, t: float) -> Array:
        """Return the path of each joint in the first ``t`` [s] of the stop (nv,) [rad]."""
        ends = np.maximum(self._seen.stops_after, 1e-12)
        ran = np.minimum(t, ends)
        return np.asarray(self._v * ran * (1.0 - 0.5 * ran / ends))

    def _distance(self, q: Array) -> float:
        return float(measure(self._cell.collision, self._at(q), self._p))

    def _at(self, q: Array) -> CollisionData:
        """Return the placements of the bodies at ``q``; the next call overwrites them."""
        update_placements(self._cell.collision, self._data, q)
        return self._data

    def _end(self, body: int, end: str, q: Array) -> Array:
        posed = self._at(q).posed
        return np.array((posed.start if end == "start" else posed.end)[self._bodies[body]])

    def _end_distance(self, body: int, end: str, q: Array) -> float:
        """Return the distance of one end of the segment of ``body`` from the other body [m]."""
        posed, other = self._at(q).posed, self._bodies[1 - body]
        point, start, along = self._end(body, end, q), posed.start[other], posed.end[other] - posed.start[other]
        length = float(along @ along)
        share = min(max(float((point - start) @ along) / length, 0.0), 1.0) if length > 0.0 else 0.0
        radii = self._cell.bodies.radius[list(self._bodies)]
        return float(np.linalg.norm(point - start - share * along) - radii.sum())

    def _closest(self, q: Array) -> tuple[Array, Array]:
        data = self._at(q)
        measure(self._cell.collision, data, self._p)
        return np.array(data.contact.first), np.array(data.contact.second)

    @staticmethod
    def _gradient(distance: Callable[[Array], float], q: Array) -> Array:
        steps = 1e-6 * np.eye(len(q))
        return np.array([distance(q + step) - distance(q - step) for step in steps]) / 2e-6

    def _gradient_of_whole(self, q: Array) -> Array:
        """Return the gradient of :meth:`_distance`. One call measures all postures, which is faster."""
        return _gradient(self._cell, q, self._p)


def _difference(seen: Seen, p: int, candidates: Iterable[_Candidate]) -> str:
    """Return what distinguishes the rows of pair ``p`` from the ``candidates``; "" if they agree."""
    written = [(seen.matrix[i], seen.lower[i]) for i in np.flatnonzero(seen.pair == p)]
    for one in candidates:
        agrees = bool(written) and np.allclose(written[0][0], one.row, rtol=0, atol=1e-4)
        if agrees and abs(written[0][1] - one.lower) <= 1e-4 * (1.0 + abs(one.lower)):
            if one.margin < -CLEAR:
                return "a row is too much"
            written.pop(0)
        elif one.margin > CLEAR:
            return f"a row is missing or different: {one.lower}, {[lower for _, lower in written]}"
    return "rows that nothing explains" if written else ""


@pytest.mark.parametrize(("may_touch", "fast"), [(False, range(10, 17)), (True, range(15, 21))])
def test_the_rows_of_a_pair_are_exactly_the_rows_of_the_documented_rule(may_touch: bool, fast: range) -> None:
    name = "dual_panda"
    model = behind(kernel_model_of(cell(name).robot, ControllerSettings()))
    if may_touch:
        model.safety.approach.contact_speed[:], model.safety.approach.contact_zone[:] = 0.02, 0.03
    most, straight_pairs = 0, 0
    for seed, speed in [*((seed, 0.4) for seed in fast), *((seed, 0.05) for seed in range(6, 14))]:
        q, v = _state(name, seed, speed)
        seen = Seen(name, q, v, model)
        for p in sorted(set(seen.pair.tolist())):
            if cell(name).bodies.box[cell(name).pairs.second[p]]:
                continue
            if _least_free(name, q, v, seen.duration, p) < 1e-3:
                continue  # Another rule applies to a pair that is too close.
            rule = _Rule(name, seen, q, v, p)
            if difference := _difference(seen, p, rule.candidates(straight=True)):
                differences = difference, _difference(seen, p, rule.candidates(straight=False))
                assert differences[1] == "", (seed, p, differences)
            most = max(most, int((seen.pair == p).sum()))
            straight_pairs += not difference
    assert most > len(INSTANTS)  # Some ends have rows of their own.
    assert straight_pairs > 0
