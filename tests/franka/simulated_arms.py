"""Start simulated Franka arms in processes of their own, and tell which reflexes they had."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from threading import Condition, Thread

ROOT = Path(__file__).parents[2]
SIMULATOR = Path(os.environ.get("FRANKA_SIM_PYTHON", ROOT / ".venv-franka-sim/bin/python"))
ADDRESSES = {"left": "127.0.0.11", "right": "127.0.0.12"}
_PATIENCE = 120.0  # [s]
_READY, _ABORTED = "Server ready for new client connection", "-- aborting the motion"
_ASKED = "asked for by a test"


def why_not() -> str | None:
    """Return why no arm can be simulated here, or None if arms can be simulated."""
    if find_spec("pylibfranka") is None:
        return "pylibfranka is not installed: make test-franka installs it"
    if not SIMULATOR.exists():
        return f"{SIMULATOR} with franka-sim does not exist: make test-franka makes it"
    return None


class SimulatedArm:
    """One simulated FR3, which starts at a posture (7,) [rad]."""

    def __init__(self, arm: str, posture: Sequence[float], folder: Path, slowness: float) -> None:
        self.name = arm
        self._command = [str(SIMULATOR), str(Path(__file__).with_name("simulated_arm.py")), ADDRESSES[arm]]
        self._command += [str(folder / f"{arm}.xml")]
        clock = str(Path(__file__).with_name("slow_clock"))
        self._environment = os.environ | {"PYTHONPATH": clock, "SLOWNESS": str(slowness)}
        self.lines: list[str] = []
        self._said = Condition()
        self.start(posture)

    def start(self, posture: Sequence[float]) -> None:
        """Start the process at a posture (7,) [rad], and wait until the robot listens."""
        self._process = subprocess.Popen(
            [*self._command, *map(str, posture)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=self._environment,
        )
        self.pid, before = self._process.pid, len(self.lines)
        Thread(target=self._listen, args=(self._process,), daemon=True).start()
        self._wait_for(_READY, before)

    def _listen(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            with self._said:
                self.lines.append(line.strip())
                self._said.notify_all()

    def _wait_for(self, words: str, since: int) -> None:
        with self._said:
            found = self._said.wait_for(lambda: any(words in line for line in self.lines[since:]), _PATIENCE)
        assert found, f"no {words!r} in {self.lines[since:]}"

    def ask(self, what: str) -> None:
        """Ask the robot for a ``reflex``, a ``user stop``, or the end of this stop."""
        before = len(self.lines)
        assert self._process.stdin is not None
        self._process.stdin.write(f"{what}\n")
        self._process.stdin.flush()
        self._wait_for(f"did: {what}", before)

    def kill(self) -> None:
        """End the process at once, as if the robot's control lost its power."""
        self._process.kill()
        self._process.wait()

    @property
    def reflexes(self) -> list[str]:
        """The lines of output about reflexes that no test has requested."""
        return [line for line in self.lines if _ABORTED in line and _ASKED not in line]
