"""How many random mutants of a package's folder do its tests notice?

    python benchmarks/mutations.py q2r2_control/teleop tests/teleop tests/pipeline

A mutant has one changed operator, constant, condition or statement. Only tests that run the changed line are run, the
fastest first, up to a limit of time for each mutant. This needs `pip install cosmic-ray pytest-cov`.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import SimpleQueue
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[1]
# Operators of this kind are not changed, because almost every | in this project stands in a type hint.
_SKIPPED_OPERATOR = "BitOr"
_PYTEST_STARTUP_S = 60.0  # Longest time that pytest takes in addition to its tests [s].


@dataclass(frozen=True)
class Mutant:
    """One change of a file. cosmic-ray's ``operator`` can change several places of the file, which are counted from 0.

    The mutant has the change at the place with the number ``occurrence``.
    """

    path: str
    operator: str
    occurrence: int
    line: int


def mutants_of(root: Path, room: str) -> Iterator[Mutant]:
    """Yield all mutants of the modules in the folder ``room``."""
    from cosmic_ray.ast import ast_nodes, get_ast_from_path
    from cosmic_ray.plugins import get_operator, operator_names

    names = [name for name in operator_names() if _SKIPPED_OPERATOR not in name and not get_operator(name).arguments()]
    for file in sorted((root / room).rglob("*.py")):
        nodes = list(ast_nodes(get_ast_from_path(file)))
        for name in names:
            operator = get_operator(name)()
            places = (start for node in nodes for start, _end in operator.mutation_positions(node))
            for occurrence, (line, _column) in enumerate(places):
                yield Mutant(str(file.relative_to(root)), name, occurrence, line)


def changed(root: Path, mutant: Mutant) -> str:
    """Return the text of the mutant's file with the change in it."""
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator

    text = mutate_code((root / mutant.path).read_bytes(), get_operator(mutant.operator)(), mutant.occurrence)
    assert text is not None, mutant
    return text if isinstance(text, str) else text.decode()


def covering_tests(
    copy: Path, env: dict[str, str], tests: Sequence[str]
) -> tuple[dict[str, dict[int, set[str]]], dict[str, float]]:
    """Return the tests that run each line of each file, and the time that each test takes [s]."""
    from coverage import CoverageData

    report, data_file = copy / "times.xml", copy / ".coverage"
    command = [*_pytest(), *tests, "--cov=q2r2_control", "--cov-context=test", "--cov-report=", f"--junitxml={report}"]
    result = subprocess.run([*command, "-o", "junit_family=xunit1"], cwd=copy, env=env, capture_output=True, text=True)
    if result.returncode:
        raise SystemExit(f"The tests fail even without a change:\n{result.stdout[-3000:]}{result.stderr[-1000:]}")
    times: dict[str, float] = {}
    for case in ElementTree.parse(report).iter("testcase"):
        times[f"{case.get('file')}::{case.get('name')}"] = float(case.get("time", "0"))
    data = CoverageData(str(data_file))
    data.read()
    lines: dict[str, dict[int, set[str]]] = {}
    for file in data.measured_files():
        by_line = data.contexts_by_lineno(file)
        lines[str(Path(file).relative_to(copy))] = {
            line: {context.split("|")[0] for context in contexts if context} for line, contexts in by_line.items()
        }
    return lines, times


def _pytest() -> list[str]:
    return [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "not slow"]


def fate(copy: Path, env: dict[str, str], mutant: Mutant, tests: Sequence[str], limit: float) -> str:
    """Return ``killed``, ``survived`` or ``uncovered``. A mutant that hangs or cannot be imported is killed."""
    if not tests:
        return "uncovered"
    file = copy / mutant.path
    original = file.read_bytes()
    try:
        file.write_text(changed(copy, mutant))
        command = [*_pytest(), "-x", *tests]
        result = subprocess.run(
            command, cwd=copy, env=env, capture_output=True, timeout=3.0 * limit + _PYTEST_STARTUP_S
        )
        return "killed" if result.returncode else "survived"
    except subprocess.TimeoutExpired:
        return "killed"
    finally:
        file.write_bytes(original)


def within(tests: set[str], times: dict[str, float], limit: float) -> list[str]:
    """Return the fastest of the ``tests``, which together take at most ``limit`` [s], but at least one test."""
    chosen: list[str] = []
    for test in sorted(tests, key=lambda test: (times.get(test, 0.0), test)):
        limit -= times.get(test, 0.0)
        if chosen and limit < 0.0:
            break
        chosen.append(test)
    return chosen


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("room", help="A folder of the package.")
    parser.add_argument("tests", nargs="*", help="Folders of the tests that should notice the mutants.")
    parser.add_argument("--root", type=Path, default=ROOT, help="The checkout, which may be an older one.")
    parser.add_argument("--count", type=int, default=200, help="Number of mutants.")
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--limit", type=float, default=60.0, help="Time of the tests for each mutant [s].")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument(
        "--python-kernels", action="store_true", help="Run kernels as Python, for rooms that contain kernels."
    )
    parser.add_argument("--json", action="store_true", help="Print JSON.")
    options = parser.parse_args()
    root = options.root.resolve()
    env = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
    if options.python_kernels:
        env["NUMBA_DISABLE_JIT"] = "1"
    with tempfile.TemporaryDirectory(prefix="mutations-") as folder:
        copies = [Path(folder) / str(job) for job in range(options.jobs)]
        tracked = subprocess.run(["git", "ls-files", "-z"], cwd=root, capture_output=True, text=True, check=True)
        for copy in copies:
            for name in filter(None, tracked.stdout.split("\0")):
                (copy / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(root / name, copy / name)
        free: SimpleQueue[Path] = SimpleQueue()
        for copy in copies:
            free.put(copy)

        def env_of(copy: Path) -> dict[str, str]:
            return {**env, "PYTHONPATH": os.pathsep.join(filter(None, (str(copy), os.environ.get("PYTHONPATH"))))}

        mutants = list(mutants_of(copies[0], options.room))
        chosen = random.Random(options.seed).sample(mutants, min(options.count, len(mutants)))
        lines, times = covering_tests(copies[0], env_of(copies[0]), options.tests)

        def ask(mutant: Mutant) -> tuple[Mutant, str]:
            copy = free.get()
            try:
                tests = within(lines.get(mutant.path, {}).get(mutant.line, set()), times, options.limit)
                return mutant, fate(copy, env_of(copy), mutant, tests, options.limit)
            finally:
                free.put(copy)

        results = []
        with ThreadPoolExecutor(options.jobs) as pool:
            for result in pool.map(ask, chosen):
                results.append(result)
                mutant, outcome = result  # Each result is shown at once, because all together take hours.
                place = f"{mutant.path}:{mutant.line} {mutant.operator.rpartition('/')[2]} {mutant.occurrence}"
                print(f"{len(results)} of {len(chosen)}: {outcome}: {place}", file=sys.stderr, flush=True)
    counts = Counter(outcome for _mutant, outcome in results)
    if options.json:
        left = [asdict(mutant) for mutant, outcome in results if outcome == "survived"]
        print(json.dumps({"room": options.room, "seed": options.seed, "of": len(mutants), **counts, "survivors": left}))
        return
    print(f"{options.room}: {dict(counts)}, of {len(mutants)} mutants, seed {options.seed}")
    for mutant, outcome in results:
        if outcome != "killed":
            print(f"  {outcome}: {mutant.path}:{mutant.line} {mutant.operator.rpartition('/')[2]}")


if __name__ == "__main__":
    main()
