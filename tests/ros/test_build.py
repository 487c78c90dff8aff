"""Builds of ROS packages: the message packages with the hashes of their types, and this repository with colcon."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import venv
from importlib import import_module
from pathlib import Path

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from q2r2_control.ros.launch.build import INTERFACES, BuildError, Interfaces, build, interface_packages, missing_tools
from q2r2_control.ros.launch.build import build_interfaces as in_this_environment
from tests.ros.conftest import need_ros
from tests.ros.processes import ROOT

need_ros()


SITE_PACKAGES = Path("lib", f"python{sys.version_info.major}.{sys.version_info.minor}", "site-packages")
NAMES = ["control_msgs", "lbr_fri_idl", "quest2ros", "tf2_msgs"]


def build_interfaces(
    *options: str, python: str | Path = sys.executable, **environment: str
) -> subprocess.CompletedProcess[str]:
    command = [python, "-m", "q2r2_control", "ros", "build-interfaces", *options]
    return subprocess.run(command, cwd=ROOT, env=os.environ | environment, capture_output=True, text=True, timeout=120)


@pytest.mark.slow
def test_the_shipped_message_packages_define_the_types_that_the_app_and_grippers_use() -> None:
    assert [package.name for package in interface_packages()] == NAMES
    assert "from quest2ros.msg import OVR2ROSInputs" in Interfaces(INTERFACES / "quest2ros").proof
    assert "from control_msgs.action import ParallelGripperCommand" in Interfaces(INTERFACES / "control_msgs").proof


@pytest.mark.slow
def test_packages_of_a_sourced_install_are_kept_and_a_package_built_beside_it_is_used_when_sourced(
    tmp_path: Path,
) -> None:
    if missing := missing_tools(Path(sys.prefix)):
        pytest.skip(f"nothing can be built here: missing {'; '.join(missing)}")
    venv.create(bare_environment := tmp_path / "bare", symlinks=True, with_pip=False)
    python, prefix = bare_environment / "bin" / "python", Path(sys.prefix)
    libraries = [prefix / "lib", *(prefix / SITE_PACKAGES).glob("ros_*.libs")]
    sourced = {  # A sourced ROS install sets these variables.
        "AMENT_PREFIX_PATH": str(prefix),
        "PYTHONPATH": os.pathsep.join(map(str, [ROOT, *filter(None, sys.path)])),
        "LD_LIBRARY_PATH": os.pathsep.join(map(str, libraries)),
    }
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


def test_the_line_of_each_build_has_the_number_of_its_package_and_the_number_of_all_packages(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The builds themselves are left out, because they take minutes."""
    built: list[str] = []
    monkeypatch.setattr("q2r2_control.ros.launch.build.build", lambda package, prefix, log: built.append(package.name))
    monkeypatch.setattr("q2r2_control.ros.launch.build.missing_tools", lambda prefix: [])
    monkeypatch.setattr(
        Interfaces, "found_in", lambda package: tmp_path if package.name in ["lbr_fri_idl", *built] else None
    )
    lines: list[str] = []
    in_this_environment(lines.append)
    said = [line.split(",")[0] for line in lines if "building" in line]
    assert said == [f"{name}: building package {NAMES.index(name) + 1} of 4" for name in built]
    assert built == ["control_msgs", "quest2ros", "tf2_msgs"]


@pytest.mark.slow
def test_without_a_compiler_the_command_prints_one_line_that_says_so(tmp_path: Path) -> None:
    """The PATH contains only make. CMake comes with the environment."""
    if (make := shutil.which("make")) is None:
        pytest.skip("needs make")
    (tmp_path / "make").symlink_to(make)
    run = build_interfaces("--force", PATH=str(tmp_path), CXX="")
    assert run.returncode == 1
    (line,) = run.stderr.splitlines()
    assert line.startswith("q2r2: ")
    assert line.endswith(" not built: missing a C++ compiler (c++ or g++ or clang++; Debian, Ubuntu: g++)")


@pytest.mark.slow
def test_a_folder_that_is_no_virtual_environment_is_refused(tmp_path: Path) -> None:
    assert f"a virtual environment that can be written to, since {tmp_path} is none" in missing_tools(tmp_path)


@pytest.mark.slow
def test_the_error_of_a_failed_build_names_the_log(tmp_path: Path) -> None:
    pytest.importorskip("catkin_pkg")
    source = tmp_path / "broken"
    source.mkdir()
    (source / "CMakeLists.txt").write_text("cmake_minimum_required(VERSION 3.16)\nmessage(FATAL_ERROR broken)\n")
    log = tmp_path / "log" / "broken.log"
    with pytest.raises(BuildError, match=f"^broken not built: cmake failed, see {log}$"):
        build(Interfaces(source), tmp_path / "prefix", log)
    assert "broken" in log.read_text()


# The fields and their order are taken from docs.ros.org/en/jazzy/p/control_msgs. A type hash depends only on the names
# and types of fields.
GRIPPER_STATE = "float64 position\nfloat64 effort\nbool stalled\nbool reached_goal"
PUBLISHED_FIELDS = {
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "control_msgs/msg/GripperCommand": "float64 position\nfloat64 max_effort",
    "control_msgs/action/GripperCommand_Goal": "control_msgs/GripperCommand command",
    "control_msgs/action/GripperCommand_Result": GRIPPER_STATE,
    "control_msgs/action/GripperCommand_Feedback": GRIPPER_STATE,
    "control_msgs/action/ParallelGripperCommand_Goal": "sensor_msgs/JointState command",
    "control_msgs/action/ParallelGripperCommand_Result": (
        "sensor_msgs/JointState state\nbool stalled\nbool reached_goal"
    ),
    "control_msgs/action/ParallelGripperCommand_Feedback": "sensor_msgs/JointState state",
}


def built_hash(kind: str) -> str:
    package, folder, name = kind.split("/")
    module = Path(import_module(package).__path__[0])  # The path is prefix/lib/python3.x/site-packages/package.
    file = module.parents[3] / "share" / package / folder / f"{name.split('_')[0]}.json"
    hashes = json.loads(file.read_text())["type_hashes"]
    return next(entry["hash_string"] for entry in hashes if entry["type_name"] == kind)


def published_hash(kind: str) -> str:
    """Return the type hash of the published fields, which rosbags computes from its own definitions of their types."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, fields in PUBLISHED_FIELDS.items():
        store.register(get_types_from_msg(fields, name))
    return store.hash_rihs01(kind)


@pytest.mark.parametrize("kind", PUBLISHED_FIELDS)
def test_a_type_has_the_hash_of_its_published_fields(kind: str) -> None:
    assert built_hash(kind) == published_hash(kind)


PACKAGE = ("package.xml", "pyproject.toml", "setup.py", "setup.cfg", "README.md", "LICENSE")
FOLDERS = ("config", "launch", "q2r2_control", "resource", "robots", "views")


def printed(folder: Path, *command: str, **environment: str) -> str:
    """Return the output of a command that runs in ``folder``, without the PYTHONPATH of these tests."""
    inherited = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    given = {"cwd": folder, "env": inherited | environment, "capture_output": True, "text": True, "timeout": 120}
    run: subprocess.CompletedProcess[str] = subprocess.run(command, **given)  # type: ignore[call-overload]
    assert run.returncode == 0, run.stdout + run.stderr
    return run.stdout


def test_colcon_installs_a_command_that_runs_with_the_installed_settings_robots_and_interfaces(tmp_path: Path) -> None:
    pytest.importorskip("colcon_ros", reason="needs colcon: pip install 'q2r2_control[dev]'")
    copy = tmp_path / "src" / "q2r2_control"
    for name in FOLDERS:
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in PACKAGE:
        shutil.copy(ROOT / name, copy)
    colcon = (sys.executable, "-c", "import sys; from colcon_core.command import main; sys.exit(main())")
    printed(tmp_path, *colcon, "build", "--event-handlers", "console_direct+", PYTHONWARNINGS="ignore")
    (elsewhere := tmp_path / "elsewhere").mkdir()
    installed = tmp_path / "install" / "q2r2_control"

    def sourced(command: str) -> str:
        return printed(elsewhere, "bash", "-c", f'. "{tmp_path}/install/local_setup.bash" && {command}')

    assert "Bimanual VR teleoperation" in sourced(f'"{installed}/lib/q2r2_control/q2r2" --help')
    assert "build-interfaces" in sourced(f'"{installed}/lib/q2r2_control/q2r2" ros --help')
    script = "import q2r2_control.config.resources as r; print(r.__file__); print(r.find_resource('robots/iiwa7.urdf'))"
    code, robot = sourced(f'"{sys.executable}" -c "{script}"').splitlines()
    assert Path(code).is_relative_to(installed / "lib")
    share = installed / "share" / "q2r2_control"
    assert Path(robot) == share / "robots" / "iiwa7.urdf"
    assert (share / "package.xml").is_file()
    patterns = ("config/*.yaml", "robots/*.urdf", "robots/*.srdf", "launch/*.py")
    shipped = {file.name for pattern in patterns for file in ROOT.glob(pattern)}
    assert {file.name for file in share.glob("*/*.*")} >= shipped
    (package,) = installed.glob("lib/python3.*/site-packages/q2r2_control/ros/interfaces")
    definitions = [file.relative_to(INTERFACES) for file in INTERFACES.rglob("*") if file.is_file()]
    assert sorted(file.relative_to(package) for file in package.rglob("*") if file.is_file()) == sorted(definitions)
