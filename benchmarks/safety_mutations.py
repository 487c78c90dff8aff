"""Does each line that keeps a promise of the controller matter? Break it, and see a hostile soak or a test fail.

Every row names a claim and one line that keeps it. The file safety_claims.py has the lines of the certificate, and
guard_claims.py has all other lines. Each line is broken in a copy of the package. If the line belongs to the
controller, `q2r2 soak` runs in this copy first. If the soak finds nothing, the tests of the line's folder run. If no
test fails either, this program exits with 1. For a line of a kernel, all kernels are compiled again, which takes a
minute or two.
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

from guard_claims import AGES, COMMANDS, CONTROL, TWO_ARMS, WATCHES
from safety_claims import CERTIFICATE, SAFETY, Mutation

ROOT = Path(__file__).resolve().parents[1]
MUTATIONS = (*CERTIFICATE, *CONTROL, *AGES, *WATCHES, *TWO_ARMS, *COMMANDS)
TESTS = {  # For each folder: the tests that run if the line of a row is in this folder.
    SAFETY: (
        "tests/control/safety",
        "tests/control/test_contract.py",
        "tests/control/test_moving_obstacles.py",
        "tests/control/test_arm_skew.py",
        "tests/control/test_live_settings.py",
        "tests/control/test_openings.py",
    ),
    "q2r2_control/control/": ("tests/control",),
    "q2r2_control/supervision/": ("tests/supervision", "tests/test_stalls.py"),
    "q2r2_control/teleop/": ("tests/teleop",),
    "q2r2_control/drives/": ("tests/drives/test_command_average.py",),
    "q2r2_control/plants/": ("tests/drives/test_command_average.py",),
    "q2r2_control/robot/": ("tests/robot/test_command_average.py",),
    "q2r2_control/loop/": ("tests/loop",),
    "q2r2_control/pipeline/": (
        "tests/pipeline/test_loop_clock.py",
        "tests/pipeline/test_requests.py",
        "tests/test_stalls.py",
    ),
}
_TIMEOUT_S = 1800.0  # Timeout for a soak or the tests [s].


def broken_copy(mutation: Mutation, folder: Path) -> None:
    """Write the package with one broken line into ``folder``, with its tests, cells and compiled kernels."""
    # The docs are copied too, because some tests compare a page with the code.
    for name in ("q2r2_control", "tests", "config", "robots", "docs"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", folder)
    kernels = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "q2r2_control"
    if kernels.is_dir():
        shutil.copytree(kernels, folder / "cache" / kernels.name)
    file = folder / mutation.path
    text = file.read_text(encoding="utf-8")
    if text.count(mutation.old) != 1:
        sys.exit(f"{mutation.path}: {mutation.old!r} occurs {text.count(mutation.old)} times; allowed: once")
    file.write_text(text.replace(mutation.old, mutation.new), encoding="utf-8")


def found_by(mutation: Mutation, ticks: int, seed: int) -> str:
    """Return the first broken promise of the soak or the first failed test, or an empty text if nothing fails."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        broken_copy(mutation, folder)
        environment = os.environ | {"PYTHONPATH": name, "XDG_CACHE_HOME": str(folder / "cache")}

        def run(*arguments: str) -> subprocess.CompletedProcess[str]:
            command = (sys.executable, "-m", *arguments)
            return subprocess.run(
                command, cwd=folder, env=environment, capture_output=True, text=True, timeout=_TIMEOUT_S
            )

        if "/control/" in mutation.path:
            soak = run("q2r2_control", "soak", "--ticks", str(ticks), "--seed", str(seed), "--json")
            if soak.returncode == 1:
                broken = json.loads(soak.stdout)["broken"]
                return f"soak, tick {broken[0]['tick']}: {broken[0]['promise']}"
            if soak.returncode:
                return f"soak: exit {soak.returncode}: {soak.stderr.strip().splitlines()[-1]}"
        its_tests = next(tests for room, tests in TESTS.items() if mutation.path.startswith(room))
        tests = run("pytest", "-q", "-x", "-p", "no:cacheprovider", *its_tests)
        if tests.returncode == 1:
            failed = [line for line in tests.stdout.splitlines() if line.startswith("FAILED")]
            return f"test {failed[0].split('::')[1].split(' - ')[0]}" if failed else "tests"
        return ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ticks", type=int, default=5000, help="Number of ticks of the soak (default: 5000).")
    parser.add_argument("--seed", type=int, default=0, help="Seed of the soak (default: 0).")
    parser.add_argument("--only", default="", help="Check only rows whose claim or file contains this text.")
    parser.add_argument(
        "--json", action="store_true", help="Print one object that maps each claim to what found its broken line."
    )
    options = parser.parse_args()
    rows: dict[str, str] = {}
    for mutation in MUTATIONS:
        if options.only in mutation.claim or options.only in mutation.path:
            rows[mutation.claim] = found_by(mutation, options.ticks, options.seed)
            if not options.json:
                print(f"{mutation.claim}: {rows[mutation.claim] or 'NOT FOUND'}", flush=True)
    if options.json:
        print(json.dumps(rows, indent=2))
    return 0 if rows and all(rows.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
