"""The lines of the safety argument, each with a change that breaks it: see safety_mutations.py.

Every row names a claim of q2r2_control/control/safety/README.md and one line that keeps it.
"""

from __future__ import annotations

from typing import NamedTuple

SAFETY = "q2r2_control/control/safety/"


class Mutation(NamedTuple):
    """A change that breaks one line. ``old`` occurs exactly once in the file."""

    claim: str
    file: str  # The name of a file in the folder SAFETY, or a path from the repository's root that has a slash.
    old: str
    new: str

    @property
    def path(self) -> str:
        return self.file if "/" in self.file else SAFETY + self.file


CERTIFICATE = (
    Mutation("P leaves room for one longest step", "joint_limits.py", "c = longest + 0.5 * h", "c = 0.5 * h"),
    Mutation(
        "the box keeps the velocity limit", "joint_limits.py", "up = min(up, limits.velocity[j])", "up = min(up, 1e3)"
    ),
    Mutation(
        "the box keeps the acceleration limit",
        "joint_limits.py",
        "box.upper[j] = clamp(up, slowest, fastest)",
        "box.upper[j] = max(up, slowest)",
    ),
    Mutation(
        "a solution is cut to the box",
        "safety_filter.py",
        "data.wanted[j] = clamp(solution[j], data.box.lower[j], data.box.upper[j])",
        "data.wanted[j] = solution[j]",
    ),
    Mutation(
        "a solution that is not finite is not used", "safety_filter.py", "if np.isfinite(total):", "if total != 1.0:"
    ),
    Mutation(
        "a stop keeps its position limits",
        "stop_rollout.py",
        "min(max(shared, _least_deceleration(model.limits, j, q[j], v[j])), a[j])",
        "min(shared, a[j])",
    ),
    Mutation(
        "the stop after a step is proven",
        "stop_certificate.py",
        "return _stop_keeps_apart(model, data, p, duration, threshold)",
        "return True",
    ),
    Mutation(
        "the step itself is proven",
        "stop_certificate.py",
        "if not _step_keeps_apart(model, data, p, h, duration, threshold):",
        "if data.distance[p] < 0.0:",
    ),
    Mutation(
        "obstacles are part of the proof",
        "stop_certificate.py",
        "if is_far(model, data, p, time) if alone else _has_room(model, data, p, time):",
        "if _has_room(model, data, p, time) or model.collision.bodies.box[model.collision.pairs.second[p]] == 1:",
    ),
    Mutation(
        "the path between two samples counts",
        "stop_certificate.py",
        "0.5 * (data.distance[p] + after - way(model, p, data.rollout.step.travel))",
        "0.5 * (data.distance[p] + after)",
    ),
    Mutation(
        "a pair that shares a joint may come closer by the path of the stop",
        "stop_certificate.py",
        "data.distance[p] - step - stop >= model.min_distance[p]",
        "data.distance[p] - step >= model.min_distance[p]",
    ),
    Mutation(
        "the rest of a stop is also a path that counts",
        "stop_certificate.py",
        "if distance - rest >= threshold:",
        "if distance >= threshold:",
    ),
    Mutation(
        "arms are proven apart also at different times",
        "stop_certificate.py",
        "return keeps_apart_at_any_time(model, data, p, duration, threshold)",
        "return _stop_keeps_apart(model, data, p, duration, threshold)",
    ),
    Mutation(
        "an arm may be where it was a window ago",
        "arm_skew.py",
        "for i in range(history.counted[0]):",
        "for i in range(0):",
    ),
    Mutation(
        "a pair that is too close must not come closer",
        "stop_certificate.py",
        "if now < before - closer:",
        "if now < -1.0:",
    ),
    Mutation(
        "a pair that is too close must not be closing in",
        "stop_certificate.py",
        "if rate < -_STILL:",
        "if rate < -1e3:",
    ),
    Mutation(
        "rounding errors do not add up",
        "stop_certificate.py",
        "if data.distance[p] < model.min_distance[p] - 0.5 * ROUNDING and not",
        "if data.distance[p] < -1.0 and not",
    ),
    Mutation(
        "a rounding error does not count as penetration",
        "safety_data.py",
        "ROUNDING = 1e-9",
        "ROUNDING = 0.0",
    ),
    Mutation(
        "bodies close in while they move",
        "speed_bound.py",
        "data.distance[p] - approach * time - way(",
        "data.distance[p] - way(",
    ),
    Mutation(
        "a change of speed, and a stop that is not straight, add to the bound",
        "speed_bound.py",
        "rollout.deviation[j] = rho + w * (0.5 * w + before)",
        "rollout.deviation[j] = w * (0.5 * w + before)",
    ),
    Mutation(
        "curvature adds to the bound by speed",
        "speed_bound.py",
        "rollout.deviation[j] = rho + w * (0.5 * w + before)",
        "rollout.deviation[j] = rho",
    ),
    Mutation(
        "a body that turns is faster than its middle",
        "speed_bound.py",
        "return between + velocities.swing[first] + velocities.swing[second]",
        "return between",
    ),
    Mutation(
        "curvature counts beside the plane",
        "separating_plane.py",
        "needed += curvature(pairs, p, piece.travel, then.travel, 1.0 if then_length > 0.0 else 0.0)",
        "needed += 0.0",
    ),
    Mutation(
        "the least gap may be inside a piece, not at its ends",
        "separating_plane.py",
        "least = min(least, value - rate * rate / (2.0 * change))",
        "least = min(least, value)",
    ),
    Mutation(
        "a joint that rests on the way may be anywhere between its ends",
        "separating_plane.py",
        "loose += min(0.0, along * piece.loose[j])",
        "loose += 0.0",
    ),
    Mutation(
        "only what was proven is executed", "safety_filter.py", "    _mix(data, low, h)\n", "    _mix(data, high, h)\n"
    ),
    Mutation(
        "an accepted step brings its own stop",
        "safety_filter.py",
        "    if _certify_mixture(model, data, 1.0, h, too_close):\n        _keep_stop(data)\n",
        "    if _certify_mixture(model, data, 1.0, h, too_close):\n",
    ),
    Mutation(
        "fingers that grow are proven at the reference",
        "safety_filter.py",
        "if data.distance[p] < model.min_distance[p]:  # No rounding",
        "if False:  # No rounding",
    ),
    Mutation(
        "a distance that grows leaves room for the path of the stop",
        "safety_data.py",
        "np.asarray(data.distance - way)",
        "np.asarray(data.distance - 0.0 * way)",
    ),
    Mutation(
        "a moving obstacle may move until the arms rest",
        "protective_distance.py",
        "way = reach(obstacles, o, max(obstacles.age[o], REPORT_AGE) + time)",
        "way = reach(obstacles, o, 0.0 * time)",
    ),
    Mutation(
        "a moving obstacle may have moved since it was reported",
        "protective_distance.py",
        "obstacles.age[o] += h",
        "obstacles.age[o] += 0.0",
    ),
)
