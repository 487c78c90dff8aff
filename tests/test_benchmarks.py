"""The scripts in benchmarks/ start, and the script that measures the loop measures all stages of a tick."""

from __future__ import annotations

import inspect
import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.support.modules import ROOT, load_script

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
SHARED = (
    *("arena_hands.py", "arena_robosuite.py", "arena_robot.py"),
    *("ros_processes.py", "work_hands.py", "safety_claims.py", "guard_claims.py"),
)
SCRIPTS = sorted(file.name for file in FOLDER.glob("*.py") if file.name not in SHARED)
NEEDED = {
    "ros": ("rclpy", "quest2ros"),
    "page": ("viser", "websockets"),
    "camera": ("cv2",),
    "qp": ("qpbenchmark",),
}  # Each key is the beginning of a script's name.


def run(script: str, *options: str) -> str:
    result = subprocess.run([sys.executable, FOLDER / script, *options], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.mark.parametrize("script", SCRIPTS)
def test_every_benchmark_has_the_option_json_and_is_described_in_the_readme(script: str) -> None:
    needed = NEEDED.get(script.split("_")[0], ())
    if absent := [name for name in needed if find_spec(name) is None]:
        pytest.skip(f"not installed: {', '.join(absent)}")
    text = (FOLDER / script).read_text(encoding="utf-8")
    assert "json" in inspect.signature(load_script(f"benchmarks/{script}").main).parameters or '"--json"' in text
    assert f"`{script}`" in (FOLDER / "README.md").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.soak
def test_answers_during_a_standstill_of_a_processor_are_separated_from_other_answers() -> None:
    bench = load_script("benchmarks/fri.py")
    answers, stills = [(0.0, 0.001), (0.010, 0.013), (0.020, 0.028)], [(0.012, 0.014), (0.030, 0.031)]
    assert bench.undisturbed(answers, stills) == pytest.approx([0.001, 0.008])
    assert bench.held_up(answers, stills) == 1


@pytest.mark.slow
def test_the_benchmark_of_the_loop_times_every_stage() -> None:
    cases = json.loads(run("loop_times.py", "--ticks", "100", "--rounds", "1", "--record", "--json"))["cases"]
    assert set(cases) == {"kinematic position", "mujoco position", "mujoco torque"}
    for stage in ("inputs", "measured state", "teleop", "supervision", "control", "drive", "apply", "physics"):
        assert all(case[stage]["median_us"] > 0.0 for case in cases.values()), stage


@pytest.mark.slow
def test_qps_of_motions_are_a_test_set_that_qpbenchmark_loads_and_daqp_solves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    benchmark = pytest.importorskip("qpbenchmark.benchmark")
    file = tmp_path / load_script("benchmarks/qp_problems.py").FILE
    told = json.loads(run("qp_problems.py", "--ticks", "40", "--solved", "8", "--file", str(file), "--json"))
    assert (told["ticks"], told["solved"]) == (40, 8)
    assert set(told["success_percent"]["daqp"].values()) == {100.0}
    monkeypatch.chdir(tmp_path)  # The test set looks for its file here.
    monkeypatch.setattr(sys, "path", [*sys.path])
    names = [problem.name for problem in benchmark.load_test_set(str(FOLDER / "qp_problems.py"))]
    assert [name.split("_")[0] for name in names] == [
        kind for kind in ("free", "contact", "limits", "recovery") for _ in range(10)
    ]
    assert len(set(names)) == 40


def test_every_line_that_a_mutation_changes_occurs_once_in_its_file() -> None:
    for mutation in load_script("benchmarks/safety_mutations.py").MUTATIONS:
        text = (ROOT / mutation.path).read_text(encoding="utf-8")
        assert text.count(mutation.old) == 1, mutation.claim
