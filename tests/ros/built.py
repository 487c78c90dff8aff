"""Interface packages of others, as far as tests need them, built beside the environment."""

from __future__ import annotations

import os
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from q2r2_control.ros.build import Interfaces, build, missing_tools

INTERFACES = Path(__file__).parent / "interfaces"


def built(prefix: Path, *names: str) -> dict[str, str]:
    """Variables for processes that import the packages ``names``, which are built into ``prefix``."""
    if missing := missing_tools(Path(sys.prefix)):
        pytest.skip(f"{', '.join(names)} cannot be built here: missing {'; '.join(missing)}")
    with ThreadPoolExecutor() as pool:
        builds = [pool.submit(build, Interfaces(INTERFACES / name), prefix, prefix / f"{name}.log") for name in names]
    for each in builds:
        each.result()
    packages = prefix / "lib" / f"python{sys.version_info.major}.{sys.version_info.minor}" / "site-packages"
    added: dict[str, list[Path | str]] = {
        "AMENT_PREFIX_PATH": [prefix, sys.prefix],
        "PYTHONPATH": [packages],
        "LD_LIBRARY_PATH": [prefix / "lib"],
    }
    return {name: os.pathsep.join([*map(str, paths), os.environ.get(name, "")]) for name, paths in added.items()}
