"""``q2r2 ros build-interfaces``: what it builds, what it leaves alone, and what it says when something is missing."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import pytest

from q2r2_control.ros.launch.build import INTERFACES, BuildError, Interfaces, build, interface_packages, missing_tools
from tests.ros.conftest import need_ros
from tests.ros.processes import ROOT

need_ros()
pytestmark = pytest.mark.slow

SITE_PACKAGES = Path("lib", f"python{sys.version_info.major}.{sys.version_info.minor}", "site-packages")
NAMES = ["control_msgs", "quest2ros", "tf2_msgs"]


def build_interfaces(
    *options: str, python: str | Path = sys.executable, **environment: str
) -> subprocess.CompletedProcess[str]:
    command = [python, "-m", "q2r2_control", "ros", "build-interfaces", *options]
    return subprocess.run(command, cwd=ROOT, env=os.environ | environment, capture_output=True, text=True, timeout=120)


@pytest.fixture
def bare_environment(tmp_path: Path) -> Path:
    """A virtual environment that holds nothing; returns its folder."""
    folder = tmp_path / "bare"
    venv.create(folder, symlinks=True, with_pip=False)
    return folder


@pytest.fixture
def sourced(bare_environment: Path) -> dict[str, str]:
    """Variables that let another environment see the packages of this one, as sourcing a ROS install does."""
    prefix = Path(sys.prefix)
    libraries = [prefix / "lib", *(prefix / SITE_PACKAGES).glob("ros_*.libs")]
    return {
        "AMENT_PREFIX_PATH": str(prefix),
        "PYTHONPATH": os.pathsep.join(map(str, [ROOT, *filter(None, sys.path)])),
        "LD_LIBRARY_PATH": os.pathsep.join(map(str, libraries)),
    }


def test_the_shipped_packages_define_what_the_app_and_grippers_use() -> None:
    assert [package.name for package in interface_packages()] == NAMES
    assert "from quest2ros.msg import OVR2ROSInputs" in Interfaces(INTERFACES / "quest2ros").proof
    assert "from control_msgs.action import ParallelGripperCommand" in Interfaces(INTERFACES / "control_msgs").proof


def test_a_sourced_install_is_left_alone_and_a_package_built_beside_it_is_used_after_sourcing_it_too(
    bare_environment: Path, sourced: dict[str, str], tmp_path: Path
) -> None:
    if missing := missing_tools(Path(sys.prefix)):
        pytest.skip(f"nothing can be built here: missing {'; '.join(missing)}")
    python = bare_environment / "bin" / "python"
    run = build_interfaces("--force", python=python, **sourced)
    assert [line.split(" (")[0] for line in run.stdout.splitlines()] == [f"{name}: already there" for name in NAMES]
    build(Interfaces(INTERFACES / "quest2ros"), bare_environment, tmp_path / "quest2ros.log")

    packages = bare_environment / SITE_PACKAGES
    path = os.pathsep.join([str(packages), sourced["PYTHONPATH"]])
    lines = build_interfaces(python=python, **(sourced | {"PYTHONPATH": path})).stdout.splitlines()
    assert f"quest2ros: already there ({packages / 'quest2ros'})" in lines
    setup_file = bare_environment / "share" / "quest2ros" / "local_setup.bash"
    assert lines[-1] == f"before use: source {setup_file}"

    script = (
        "from rclpy.serialization import serialize_message\n"
        "import quest2ros\n"
        "from quest2ros.msg import OVR2ROSHapticFeedback as Haptic\n"
        "print(quest2ros.__path__[0], len(serialize_message(Haptic(frequency=0.5, amplitude=0.25))))\n"
    )
    command = ["bash", "-c", 'source "$0" && "$1" -c "$2"', str(setup_file), str(python), script]
    run = subprocess.run(command, env=os.environ | sourced, capture_output=True, text=True, timeout=60)
    assert run.stdout.split() == [str(packages / "quest2ros"), "12"], run.stderr


def test_without_a_compiler_one_line_says_so(tmp_path: Path) -> None:
    """With a PATH that has make and nothing else; CMake comes with the environment."""
    if (make := shutil.which("make")) is None:
        pytest.skip("needs make")
    (tmp_path / "make").symlink_to(make)
    run = build_interfaces("--force", PATH=str(tmp_path), CXX="")
    assert run.returncode == 1
    (line,) = run.stderr.splitlines()
    assert line.startswith("q2r2: ")
    assert line.endswith(" not built: missing a C++ compiler (c++ or g++ or clang++; Debian, Ubuntu: g++)")


def test_a_folder_that_no_python_looks_into_is_refused(tmp_path: Path) -> None:
    assert f"a virtual environment that can be written to, since {tmp_path} is none" in missing_tools(tmp_path)


def test_a_build_that_fails_names_its_log(tmp_path: Path) -> None:
    pytest.importorskip("catkin_pkg")
    source = tmp_path / "broken"
    source.mkdir()
    (source / "CMakeLists.txt").write_text("cmake_minimum_required(VERSION 3.16)\nmessage(FATAL_ERROR broken)\n")
    log = tmp_path / "log" / "broken.log"
    with pytest.raises(BuildError, match=f"^broken not built: cmake failed, see {log}$"):
        build(Interfaces(source), tmp_path / "prefix", log)
    assert "broken" in log.read_text()


def test_importing_the_package_imports_no_rclpy() -> None:
    code = "import sys, q2r2_control.ros.launch.processes; print('rclpy' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (run.stdout, run.stderr) == ("False\n", "")


def test_the_names_that_subclasses_need_come_from_the_package() -> None:
    pytest.importorskip("quest2ros", reason="needs q2r2 ros build-interfaces")
    from q2r2_control.ros import BaseArmController, BaseNode, run_node

    assert issubclass(BaseArmController, BaseNode)
    assert callable(run_node)
    with pytest.raises(ImportError):
        from q2r2_control.ros import no_such_name  # noqa: F401
