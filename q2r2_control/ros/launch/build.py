"""Build the interface packages under ``interfaces/`` into the running environment, where no other install has them."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from q2r2_control.errors import Q2R2Error

INTERFACES = Path(__file__).parents[1] / "interfaces"
# What the generators and ament import while CMake runs; rclpy is what the result is for.
_PYTHON_TOOLS = ("rclpy", "rosidl_adapter", "rosidl_generator_py", "catkin_pkg", "em", "lark", "numpy")
_CMAKE_PACKAGES = ("ament_cmake", "rosidl_default_generators")
_COMPILERS = ("c++", "g++", "clang++")


class BuildError(Q2R2Error):
    """Interfaces cannot be built; the message says what is missing, or which file holds the build's log."""


@dataclass(frozen=True, slots=True)
class Interfaces:
    """One interface package: where its definitions are, and the types that they make."""

    source: Path

    @property
    def name(self) -> str:
        return self.source.name

    @property
    def types(self) -> list[tuple[str, str]]:
        """Module and name of every type, such as ("quest2ros.msg", "OVR2ROSInputs")."""
        files = sorted([*self.source.glob("msg/*.msg"), *self.source.glob("action/*.action")])
        return [(f"{self.name}.{file.parent.name}", file.stem) for file in files]

    @property
    def proof(self) -> str:
        """Python code that fails unless all types can be imported; messages are serialised."""
        lines = ["from rclpy.serialization import serialize_message"]
        for module, kind in self.types:
            probe = f"{kind}.Goal()" if module.endswith(".action") else f"{kind}()"
            lines += [f"from {module} import {kind}", f"serialize_message({probe})"]
        return "\n".join([*lines, f"import {self.name}"])

    def found_in(self) -> Path | None:
        """The folder that a fresh Python imports all types from, or None."""
        # Where a ROS is sourced, this environment's libraries are found once its own setup file is sourced too; the
        # user is told so, and here the path does the same.
        libraries = os.pathsep.join(filter(None, [str(Path(sys.prefix, "lib")), os.environ.get("LD_LIBRARY_PATH")]))
        environment = os.environ | {"LD_LIBRARY_PATH": libraries}
        command = [sys.executable, "-c", f"{self.proof}\nprint({self.name}.__path__[0])"]
        run = subprocess.run(command, env=environment, capture_output=True, text=True)
        return Path(run.stdout.splitlines()[-1]) if run.returncode == 0 else None


def interface_packages() -> list[Interfaces]:
    """All packages that ship with this one, by name."""
    return [Interfaces(file.parent) for file in sorted(INTERFACES.glob("*/package.xml"))]


def build_interfaces(report: Callable[[str], None], force: bool = False) -> None:
    """Build what cannot be imported and ``report`` one line a package.

    ``force`` builds again what this environment holds; what another install has, such as one that apt made and that is
    sourced, is always left alone. Raises :class:`BuildError`.
    """
    prefix = Path(sys.prefix)
    packages = interface_packages()
    with ThreadPoolExecutor(_workers()) as pool:
        found = dict(zip(packages, pool.map(Interfaces.found_in, packages), strict=True))
        wanted = [package for package, folder in found.items() if folder is None or (force and _is_in(folder, prefix))]
        for package, folder in found.items():
            if package not in wanted:
                report(f"{package.name}: already there ({folder})")
        if wanted and (missing := missing_tools(prefix)):
            names = ", ".join(package.name for package in wanted)
            raise BuildError(f"{names} not built: missing {'; '.join(missing)}")
        futures = [pool.submit(_build_and_check, package, prefix) for package in wanted]
        errors = [error for future in futures if (error := future.exception())]
        for future in futures:
            if not future.exception():
                report(future.result())
    if errors:
        raise BuildError("; ".join(map(str, errors)))
    held = [*wanted, *(package for package, folder in found.items() if folder and _is_in(folder, prefix))]
    if held and _is_overlay(prefix):
        report(f"before use: source {prefix}/share/{held[0].name}/local_setup.bash")


def missing_tools(prefix: Path) -> list[str]:
    """What a build into ``prefix`` needs and does not have, each with where to get it."""
    missing = []
    if not _python_looks_into(prefix):
        missing.append(f"a virtual environment that can be written to, since {prefix} is none")
    compilers = [os.environ["CXX"].split()[0]] if os.environ.get("CXX", "").strip() else _COMPILERS
    if not _found(compilers):
        missing.append(f"a C++ compiler ({' or '.join(compilers)}; Debian, Ubuntu: g++)")
    if not _found(["make"]):
        missing.append("make")
    if not _found(["cmake"]):
        missing.append("cmake (pip install cmake)")
    if not Path(sysconfig.get_path("include"), "Python.h").is_file():
        missing.append("Python's headers (Debian, Ubuntu: python3-dev)")
    modules = [name for name in _PYTHON_TOOLS if importlib.util.find_spec(name) is None]
    shares = [
        name for name in _CMAKE_PACKAGES if not any((root / "share" / name).is_dir() for root in _prefix_path(prefix))
    ]
    if modules or shares:
        names = ", ".join([*modules, *shares])
        missing.append(f"ROS 2 Jazzy with its build tools ({names}; pip install 'q2r2_control[ros]', or source a ROS)")
    return missing


def build(package: Interfaces, prefix: Path, log: Path) -> float:
    """Configure, compile and install ``package`` into ``prefix``; returns seconds. Raises :class:`BuildError`.

    All output goes to the file ``log``.
    """
    start = time.monotonic()
    cmake = _found(["cmake"]) or "cmake"
    path = os.pathsep.join(map(str, _prefix_path(prefix)))
    environment = os.environ | {"AMENT_PREFIX_PATH": path, "CMAKE_PREFIX_PATH": path}
    log.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f"{package.name}-") as folder, log.open("w", encoding="utf-8") as output:
        for command in (
            [
                *(cmake, "-S", str(package.source), "-B", folder),
                f"-DCMAKE_INSTALL_PREFIX={prefix}",
                f"-DCMAKE_INSTALL_RPATH={prefix / 'lib'}",
                f"-DPython3_EXECUTABLE={sys.executable}",
                "-DCMAKE_BUILD_TYPE=Release",
            ],
            [cmake, "--build", folder, "--parallel", str(_workers())],
            [cmake, "--install", folder],
        ):
            run = subprocess.run(command, env=environment, stdout=output, stderr=subprocess.STDOUT)
            if run.returncode != 0:
                raise BuildError(f"{package.name} not built: cmake failed, see {log}")
    return time.monotonic() - start


def _build_and_check(package: Interfaces, prefix: Path) -> str:
    log = prefix / "share" / "q2r2_control" / "log" / f"{package.name}.log"
    seconds = build(package, prefix, log)
    if package.found_in() is None:
        raise BuildError(f"{package.name} was built into {prefix} but cannot be imported, see {log}")
    return f"{package.name}: built in {seconds:.0f} s (log: {log})"


def _workers() -> int:
    return os.cpu_count() or 1


def _found(programs: Iterable[str]) -> str | None:
    """The first of ``programs`` that is beside the running Python or on the PATH."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
    return next((found for name in programs if (found := shutil.which(name, path=path))), None)


def _python_looks_into(prefix: Path) -> bool:
    """Whether modules that a build installs into ``prefix`` can be imported; Debian's own Python looks elsewhere."""
    packages = prefix / "lib" / f"python{sys.version_info.major}.{sys.version_info.minor}" / "site-packages"
    return Path(sysconfig.get_path("purelib")) == packages and os.access(packages, os.W_OK)


def _is_in(folder: Path, prefix: Path) -> bool:
    return folder.resolve().is_relative_to(prefix.resolve())


def _sourced() -> list[Path]:
    """The ROS installs that are sourced; none where ROS is part of the environment."""
    return [Path(root) for root in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if root]


def _prefix_path(prefix: Path) -> list[Path]:
    """Where CMake finds packages: in ``prefix``, the running environment and every ROS that is sourced."""
    return list(dict.fromkeys([prefix, Path(sys.prefix), *_sourced()]))


def _is_overlay(prefix: Path) -> bool:
    """Whether the sourced ROS does not know of ``prefix`` yet, and so does not find its libraries."""
    return bool(_sourced()) and prefix not in _sourced()
