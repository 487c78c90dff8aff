"""Judge recordings in Python: python examples/judge_in_python.py [RECORDINGS...]. Without RECORDINGS, it makes one."""

import subprocess
import sys
import tempfile
from pathlib import Path

from q2r2_control.judging import JudgeSettings, Unreadable, judge_all
from q2r2_control.recording import recordings_in


def record(folder: str) -> Path:
    """Record two seconds of scripted hands in simulated time, and return the folder of the recording."""
    command = [sys.executable, "-m", "q2r2_control", "run", "config/dual_iiwa7.yaml", "--headless", "--fast"]
    subprocess.run([*command, "--duration", "2", "--record", folder], check=True, stdout=subprocess.DEVNULL)
    return Path(folder)


with tempfile.TemporaryDirectory() as folder:
    given = [Path(path) for path in sys.argv[1:]] or [record(folder)]
    # These are thresholds of your own. Without ``settings``, judge_all uses the thresholds of the recorded cell.
    settings = JudgeSettings(max_position_error_rms=0.02, max_idle_share=0.95)
    for judged in judge_all(recordings_in(given), settings):
        if isinstance(judged, Unreadable):
            print(f"{judged.file}: {judged.line}")
            continue
        print(f"{judged.figures.name}: {judged.verdict.line}")
        for name, arm in judged.figures.arms.items():
            error = arm.position_error_mm_rms
            print(f"  {name} arm: {'never engaged' if error is None else f'tracking error {error:.1f} mm RMS'}")
