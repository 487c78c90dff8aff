"""Does each line that keeps a promise of the controller matter? Break it, and see a hostile soak or a test fail.

Every row names a claim of q2r2_control/control/safety/README.md and one line that keeps it. The line is changed in a
copy of the package. Then `q2r2 soak` runs there, and where that finds nothing the tests of the controller. A row that
both pass is a line without teeth: exit 1. The kernels are compiled anew for each row, which takes a minute or two.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
SAFETY = "q2r2_control/control/safety/"
TESTS = (
    "tests/control/safety",
    "tests/control/test_contract.py",
    "tests/control/test_moving_obstacles.py",
    "tests/control/test_arm_skew.py",
)
_LONGEST = 1800.0  # of a soak or the tests [s]


class Mutation(NamedTuple):
    """One line, broken. ``old`` stands once in the file."""

    claim: str
    file: str  # below SAFETY, or from the root where it names a folder
    old: str
    new: str

    @property
    def path(self) -> str:
        return self.file if "/" in self.file else SAFETY + self.file


MUTATIONS = (
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
        "numbers that are not finite are no solution", "safety_filter.py", "if np.isfinite(total):", "if total != 1.0:"
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
        "between two samples the way counts",
        "stop_certificate.py",
        "0.5 * (data.distance[p] + after - way(model, p, data.rollout.step.travel))",
        "0.5 * (data.distance[p] + after)",
    ),
    Mutation(
        "a pair that shares a joint may come closer by the way of the stop",
        "stop_certificate.py",
        "data.distance[p] - step - stop >= model.min_distance[p]",
        "data.distance[p] - step >= model.min_distance[p]",
    ),
    Mutation(
        "what is left of a stop is a way too",
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
        "rounding does not add up",
        "stop_certificate.py",
        "if data.distance[p] < model.min_distance[p] - 0.5 * ROUNDING and not",
        "if data.distance[p] < -1.0 and not",
    ),
    Mutation(
        "rounding is no penetration",
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
        "a gap is least inside a piece",
        "separating_plane.py",
        "least = min(least, value - rate * rate / (2.0 * change))",
        "least = min(least, value)",
    ),
    Mutation(
        "a joint that rests on the way is anywhere between its ends",
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
        "if data.distance[p] < model.min_distance[p]:  # no rounding",
        "if False:  # no rounding",
    ),
    Mutation(
        "a distance that grows leaves the way of the stop",
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


def broken_copy(mutation: Mutation, folder: Path) -> None:
    """Write the package with one line broken, its tests and its cells, into ``folder``."""
    for name in ("q2r2_control", "tests", "config", "robots"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", folder)
    file = folder / mutation.path
    text = file.read_text(encoding="utf-8")
    if text.count(mutation.old) != 1:
        sys.exit(f"{mutation.path}: {mutation.old!r} stands there {text.count(mutation.old)} times; expected 1")
    file.write_text(text.replace(mutation.old, mutation.new), encoding="utf-8")


def found_by(mutation: Mutation, ticks: int, seed: int) -> str:
    """The first broken promise of the soak, "tests", or nothing where neither finds the line."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        broken_copy(mutation, folder)
        environment = os.environ | {"PYTHONPATH": name, "XDG_CACHE_HOME": str(folder / "cache")}

        def run(*arguments: str) -> subprocess.CompletedProcess[str]:
            command = (sys.executable, "-m", *arguments)
            return subprocess.run(
                command, cwd=folder, env=environment, capture_output=True, text=True, timeout=_LONGEST
            )

        soak = run("q2r2_control", "soak", "--ticks", str(ticks), "--seed", str(seed), "--json")
        if soak.returncode == 1:
            broken = json.loads(soak.stdout)["broken"]
            return f"soak, tick {broken[0]['tick']}: {broken[0]['promise']}"
        if soak.returncode:
            return f"soak: exit {soak.returncode}: {soak.stderr.strip().splitlines()[-1]}"
        tests = run("pytest", "-q", "-x", "-p", "no:cacheprovider", *TESTS)
        if tests.returncode == 1:
            failed = [line for line in tests.stdout.splitlines() if line.startswith("FAILED")]
            return f"test {failed[0].split('::')[1].split(' - ')[0]}" if failed else "tests"
        return ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ticks", type=int, default=5000, help="of the soak (default: 5000)")
    parser.add_argument("--seed", type=int, default=0, help="of the soak (default: 0)")
    parser.add_argument("--only", default="", help="only rows whose claim contains this")
    parser.add_argument("--json", action="store_true", help="one object: claim -> what found it")
    options = parser.parse_args()
    rows: dict[str, str] = {}
    for mutation in MUTATIONS:
        if options.only in mutation.claim:
            rows[mutation.claim] = found_by(mutation, options.ticks, options.seed)
            if not options.json:
                print(f"{mutation.claim}: {rows[mutation.claim] or 'NOT FOUND'}", flush=True)
    if options.json:
        print(json.dumps(rows, indent=2))
    return 0 if rows and all(rows.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
