"""Build the interface packages under ``interfaces/`` into the running environment, if no other install has them."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from q2r2_control.errors import Q2R2Error
from q2r2_control.extras import install_line

INTERFACES = Path(__file__).parents[1] / "interfaces"
# Packages that the generators and ament import while CMake runs, and rclpy, for which the result is made.
_PYTHON_TOOLS = ("rclpy", "rosidl_adapter", "rosidl_generator_py", "catkin_pkg", "em", "lark", "numpy")


class BuildError(Q2R2Error):
    """Interfaces cannot be built. The message says what is missing, or which file holds the build's log."""


@dataclass(frozen=True, slots=True)
class Interfaces:
    source: Path

    @property
    def name(self) -> str:
        return self.source.name

    @property
    def proof(self) -> str:
        """Python code that fails unless all types can be imported and serialised."""
        lines = ["from rclpy.serialization import serialize_message"]
        for file in sorted([*self.source.glob("msg/*.msg"), *self.source.glob("action/*.action")]):
            probe = f"{file.stem}.Goal()" if file.suffix == ".action" else f"{file.stem}()"
            lines += [f"from {self.name}.{file.parent.name} import {file.stem}", f"serialize_message({probe})"]
        return "\n".join([*lines, f"import {self.name}"])

    def found_in(self) -> Path | None:
        """Return the folder from which a new Python process imports all types, or None."""
        # Libraries are found as if the setup file of this environment was sourced after the setup file of a ROS.
        libraries = os.pathsep.join(filter(None, [str(Path(sys.prefix, "lib")), os.environ.get("LD_LIBRARY_PATH")]))
        command = [sys.executable, "-c", f"{self.proof}\nprint({self.name}.__path__[0])"]
        environment = os.environ | {"LD_LIBRARY_PATH": libraries}
        run = subprocess.run(command, env=environment, capture_output=True, text=True)
        return Path(run.stdout.splitlines()[-1]) if run.returncode == 0 else None


def interface_packages() -> list[Interfaces]:
    return [Interfaces(file.parent) for file in sorted(INTERFACES.glob("*/package.xml"))]


def build_interfaces(report: Callable[[str], None], force: bool = False) -> None:
    """Build packages that cannot be imported, and ``report`` one line for each; raises :class:`BuildError`.

    ``force`` builds the packages of this environment again. Packages of another install, such as a sourced ROS, are not
    changed.
    """
    prefix = Path(sys.prefix)
    held = []  # Packages of this environment.
    packages = interface_packages()
    for number, package in enumerate(packages, start=1):
        folder = package.found_in()
        own = folder is None or folder.resolve().is_relative_to(prefix.resolve())
        if own:
            held.append(package.name)
        if folder is not None and not (force and own):
            report(f"{package.name}: already there ({folder})")
            continue
        if missing := missing_tools(prefix):
            raise BuildError(f"{package.name} not built: missing {'; '.join(missing)}")
        log = prefix / "share" / "q2r2_control" / "log" / f"{package.name}.log"
        place = f"package {number} of {len(packages)}"
        report(f"{package.name}: building {place}, in half a minute to two minutes, by how busy the computer is")
        began = time.monotonic()
        build(package, prefix, log)
        if package.found_in() is None:
            raise BuildError(f"{package.name} was built into {prefix} but cannot be imported, see {log}")
        report(f"{package.name}: built in {time.monotonic() - began:.0f} s (log: {log})")
    sourced = _sourced()
    # A further file has to be sourced, because the sourced ROS does not find the packages' libraries.
    if held and sourced and prefix not in sourced:
        report(f"before use: source {prefix}/share/{held[0]}/local_setup.bash")


def build_missing(report: Callable[[str], None]) -> None:
    """Build the message packages if this environment lacks some; raises :class:`BuildError`.

    Only the packages' names are looked up. To import all packages would delay the start of nodes by seconds.
    """
    if any(importlib.util.find_spec(package.name) is None for package in interface_packages()):
        report("building message packages, once for this environment")
        build_interfaces(report)
        importlib.invalidate_caches()


def missing_tools(prefix: Path) -> list[str]:
    """Return one text for each thing that a build into ``prefix`` lacks. The text says where to get it."""
    missing = []
    # ``packages`` is compared with Python's own folder, because Debian's own Python imports from another folder.
    packages = prefix / "lib" / f"python{sys.version_info.major}.{sys.version_info.minor}" / "site-packages"
    if Path(sysconfig.get_path("purelib")) != packages or not os.access(packages, os.W_OK):
        missing.append(f"a virtual environment that can be written to, since {prefix} is none")
    compilers = [os.environ["CXX"].split()[0]] if os.environ.get("CXX", "").strip() else ["c++", "g++", "clang++"]
    if not any(map(_found, compilers)):
        missing.append(f"a C++ compiler ({' or '.join(compilers)}; Debian, Ubuntu: g++)")
    tools = {"make": "make", "cmake": "cmake (pip install cmake)"}
    missing += [source for tool, source in tools.items() if not _found(tool)]
    if not Path(sysconfig.get_path("include"), "Python.h").is_file():
        missing.append("Python's headers (Debian, Ubuntu: python3-dev)")
    absent = [name for name in _PYTHON_TOOLS if importlib.util.find_spec(name) is None]
    if not any((root / "share" / "rosidl_default_generators").is_dir() for root in _prefix_path(prefix)):
        absent.append("rosidl_default_generators")
    if absent:
        names = ", ".join(absent)
        missing.append(f"ROS 2 Jazzy with its build tools ({names}; {install_line('ros')}, or source a ROS)")
    return missing


def build(package: Interfaces, prefix: Path, log: Path) -> None:
    """Compile and install ``package`` into ``prefix``, with all output in ``log``; raises :class:`BuildError`."""
    cmake = _found("cmake") or "cmake"
    path = os.pathsep.join(map(str, _prefix_path(prefix)))
    environment = os.environ | {"AMENT_PREFIX_PATH": path, "CMAKE_PREFIX_PATH": path}
    log.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f"{package.name}-") as folder, log.open("w", encoding="utf-8") as output:
        options = {
            "CMAKE_INSTALL_PREFIX": prefix,
            "CMAKE_INSTALL_RPATH": prefix / "lib",
            "Python3_EXECUTABLE": sys.executable,
            "CMAKE_BUILD_TYPE": "Release",
        }
        for command in (
            [cmake, "-S", str(package.source), "-B", folder, *(f"-D{key}={value}" for key, value in options.items())],
            [cmake, "--build", folder, "--parallel", str(os.cpu_count() or 1)],
            [cmake, "--install", folder],
        ):
            run = subprocess.run(command, env=environment, stdout=output, stderr=subprocess.STDOUT)
            if run.returncode != 0:
                raise BuildError(f"{package.name} not built: cmake failed, see {log}")


def _found(program: str) -> str | None:
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
    return shutil.which(program, path=path)


def _sourced() -> list[Path]:
    return [Path(root) for root in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if root]


def _prefix_path(prefix: Path) -> list[Path]:
    """Return the folders in which CMake finds packages: ``prefix``, the running environment and every sourced ROS."""
    return list(dict.fromkeys([prefix, Path(sys.prefix), *_sourced()]))
