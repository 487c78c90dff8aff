"""Write the rows of the QP for an arm that moves behind another arm, in the same direction.

The real arm in front may be late by up to a window D [s]: it may still be at the posture that the reference had D ago.
It may also stop alone (arm_skew.py). The rows therefore use this earlier posture of the arm in front, and the posture
in which the arm behind would come to rest. Let d be the distance of a pair at the reference, and let its normal n point
from the arm behind to the arm in front. The free distance is

    B = d - min_distance - buffer - n'(motion of the front arm in the window) - n'(motion of the arm behind in a stop).

As in separation_rows.py, a step of h [s] may use up only a share of B: after the step, B has to be at least
(1 - gain h) times its value before. In a step, B changes by two motions: by the motion that the arm in front made D
ago, and by the present motion of the arm behind. The present motion of the arm in front changes B only when the time D
has passed.
"""

from __future__ import annotations

from q2r2_control.control.geometry.closest_points import size_of
from q2r2_control.control.geometry.pair_distance import distance_row, measure
from q2r2_control.control.jit import kernel
from q2r2_control.control.safety.safety_data import SafetyData, SafetyModel


@kernel
def append_following_row(
    model: SafetyModel, data: SafetyData, p: int, h: float, duration: float, gain: float, count: int
) -> int:
    """Add the row of pair ``p`` of two arms if one arm moves behind the other arm and the row may bind.

    Args:
        model: The model.
        data: The data.
        p: The pair.
        h: Duration of the step [s].
        duration: Duration of the certified stop [s].
        gain: Gain of the rows, see separation_rows.py [1/s].
        count: Number of rows so far.

    Returns:
        The number of rows afterwards.
    """
    pairs, history, v, row = model.collision.pairs, data.history, data.state.v, data.rows.matrix[count]
    distance = measure(model.collision, data.collision, p)
    if distance < model.min_distance[p] or history.counted[0] == 0:
        # A pair that is too close gets no such row, because its distance has to grow, whichever arm is in front.
        return count
    distance_row(model.collision, data.collision, p, row)
    first, second = 0.0, 0.0
    for k in range(pairs.joint.shape[1]):
        joint = pairs.joint[p, k]
        if joint == 0:
            break
        rate = row[joint - 1] * v[joint - 1]
        if pairs.sign[p, k] < 0.0:
            first += rate
        else:
            second += rate
    if min(first, second) >= 0.0 or max(first, second) <= 0.0:
        return count
    behind = -1.0 if first < 0.0 else 1.0
    oldest = history.counted[0] - 1
    free, rate, before, change = distance - model.approach.stop_distance[p], min(first, second), 0.0, 0.0
    for k in range(pairs.joint.shape[1]):
        joint = pairs.joint[p, k]
        if joint == 0:
            break
        j = joint - 1
        if pairs.sign[p, k] == behind:
            free += row[j] * 0.5 * v[j] * abs(v[j]) / data.certified[j]
            change += abs(row[j]) * model.limits.acceleration[j]
        else:
            free += row[j] * (history.q[oldest, j] - data.state.q[j])
            before += row[j] * history.v[oldest, j]
            row[j] = 0.0
    lever = max(0.5 * duration, 0.5 * h) + 0.5 * h
    change *= h * lever
    allowed = -gain * h * free - h * before
    if h * rate - change >= allowed or change <= 0.0:
        return count
    size = size_of(row)
    row /= size
    data.rows.lower[count] = (rate + (allowed - h * rate) / lever) / size
    data.rows.pair[count] = p
    return count + 1
