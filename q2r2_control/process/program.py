"""The versions of the program, the machine and the libraries, as recordings and sign-offs note them."""

from __future__ import annotations

import platform
import subprocess
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_GIT_TIME = 2.0  # The longest time that git may take [s].


def program() -> dict[str, str]:
    """Return notes on the program's version, the machine and the libraries, by name.

    If the program runs from a git checkout, they include its revision, which ends with -dirty if files were changed.
    """
    notes = {"version": _version("q2r2_control"), "machine": f"{platform.node()}, {platform.platform()}"}
    notes["libraries"] = ", ".join(f"{name} {_version(name)}" for name in ("numpy", "pin", "numba", "daqp", "mujoco"))
    checkout = Path(__file__).resolve().parents[2]
    if (checkout / ".git").exists():
        command = ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--abbrev=40"]
        with suppress(OSError, subprocess.SubprocessError):
            done = subprocess.run(command, capture_output=True, text=True, timeout=_GIT_TIME, check=True)
            notes["revision"] = done.stdout.strip()
    return notes


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"
