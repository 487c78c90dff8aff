"""Message packages of other projects, as far as tests need them, built beside the environment."""

from __future__ import annotations

import fcntl
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from q2r2_control.ros.launch.build import Interfaces, build, missing_tools

INTERFACES = Path(__file__).parent / "interfaces"


def build_interfaces(folder: Path, *names: str) -> dict[str, str]:
    """Variables for processes that import the packages ``names``, built into ``folder`` by the first worker."""
    prefix = folder / "interfaces"
    if missing := missing_tools(Path(sys.prefix)):
        pytest.skip(f"{', '.join(names)} cannot be built here: missing {'; '.join(missing)}")
    done = folder / "interfaces.done"
    with (folder / "interfaces.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.exists():
            _build(prefix, names)
            done.touch()
    packages = prefix / "lib" / f"python{sys.version_info.major}.{sys.version_info.minor}" / "site-packages"
    added: dict[str, list[Path | str]] = {
        "AMENT_PREFIX_PATH": [prefix, sys.prefix],
        "PYTHONPATH": [packages],
        "LD_LIBRARY_PATH": [prefix / "lib"],
    }
    return {name: os.pathsep.join([*map(str, paths), os.environ.get(name, "")]) for name, paths in added.items()}


def _build(prefix: Path, names: Sequence[str]) -> None:
    prefix.mkdir(exist_ok=True)
    with ThreadPoolExecutor() as pool:
        builds = [pool.submit(build, Interfaces(INTERFACES / name), prefix, prefix / f"{name}.log") for name in names]
    for each in builds:
        each.result()
