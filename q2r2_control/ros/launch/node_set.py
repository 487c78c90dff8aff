"""Which nodes a cell needs, with which parameters: for ``q2r2 ros up`` and for the launch file."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field

from q2r2_control.config import load_config
from q2r2_control.config.external import ControllerKind, ExternalConfig
from q2r2_control.errors import ConfigError
from q2r2_control.types import SIDES

SOURCES = ("scripted", "headset", "none")
ROBOTS = ("auto", "mujoco", "none")


@dataclass(frozen=True, slots=True)
class NodeProcess:
    """One node to start: its executable's name, its module, and its parameters."""

    name: str
    module: str
    parameters: Mapping[str, str | float] = field(default_factory=dict)

    def command(self) -> list[str]:
        """What starts it with this Python."""
        parameters = [part for key, value in self.parameters.items() for part in ("-p", f"{key}:={value}")]
        return [sys.executable, "-u", "-m", self.module, "--ros-args", *parameters]


def nodes_of(path: str, source: str = "scripted", robot: str = "auto") -> list[NodeProcess]:
    """The set for a cell's YAML, in the order of their start.

    ``source`` of the hands: scripted, headset or none. ``robot``: mujoco, none, or auto, which is mujoco for
    ``controller: builtin`` only. Raises :class:`ConfigError`.
    """
    for name, value, allowed in (("input", source, SOURCES), ("robot", robot, ROBOTS)):
        if value not in allowed:
            raise ConfigError(f"{name} = {value!r:.60}: allowed are {', '.join(allowed)}")
    cell = load_config(path)
    config: dict[str, str | float] = {"config": path}
    nodes = []
    if robot == "mujoco" or (robot == "auto" and cell.controller is ControllerKind.BUILTIN):
        nodes.append(_node("mujoco_robot", config))
    if cell.external is None:
        nodes.append(_node("cartesian_controller", config))
    elif cell.external.filtered:
        nodes.append(_node("cartesian_controller", config | _relayed(cell.external)))
    nodes += [_node(f"{arm}_arm_controller", config) for arm in SIDES if arm in cell.arms]
    if source == "scripted":
        nodes.append(NodeProcess("SimulationInput", "q2r2_control.ros.nodes.simulation_input"))
    elif source == "headset":
        nodes.append(_node("tcp_endpoint", config))
    return nodes


def _node(name: str, parameters: Mapping[str, str | float]) -> NodeProcess:
    return NodeProcess(name, f"q2r2_control.ros.nodes.{name}", parameters)


def _relayed(external: ExternalConfig) -> dict[str, str | float]:
    """What makes the built-in controller one that others follow: nothing, or joints, for each arm on its own."""
    preset = external.terms
    parameters: dict[str, str | float] = {"output": preset.output}
    if not preset.takes_poses:
        parameters["rate"] = float(external.rate or preset.rate)
    for arm, theirs in external.arms.items():
        parameters[f"{arm}.target_frame_id"] = external.world_frame or theirs.base_frame
        parameters[f"{arm}.joint_states_topic"] = theirs.joint_states_topic
        if not preset.takes_poses:
            parameters[f"{arm}.output_topic"] = external.topic(arm)
    return parameters
