"""Read a recording as NumPy arrays: python examples/replay_to_numpy.py [RECORDING]. Without RECORDING, it makes one."""

import subprocess
import sys
import tempfile
from pathlib import Path

from q2r2_control.export import FrameSampling, make_episode
from q2r2_control.recording import recordings_in


def record(folder: str) -> Path:
    """Record two seconds of scripted hands in simulated time, and return the path of the recording."""
    command = [sys.executable, "-m", "q2r2_control", "run", "config/dual_iiwa7.yaml", "--headless", "--fast"]
    subprocess.run(
        [*command, "--duration", "2", "--record", folder, "--task", "swing"], check=True, stdout=subprocess.DEVNULL
    )
    return recordings_in([Path(folder)])[0]


with tempfile.TemporaryDirectory() as folder:
    file = Path(sys.argv[1]) if len(sys.argv) > 1 else record(folder)
    episode = make_episode(file, FrameSampling(fps=50))

print(f"{episode.recording}: {episode.frames} frames of task {episode.task!r} in cell {episode.cell}")
for name, values in episode.vectors.items():
    print(f"{name:22} {values.dtype} {values.shape}  {', '.join(episode.names[name][:3])}, ...")

positions, commands = episode.vectors["observation.state"], episode.vectors["action"]
joints = slice(0, len(episode.names["observation.velocity"]))
print(f"largest difference of command and joint: {abs(commands[:, joints] - positions[:, joints]).max():.4f} rad")
