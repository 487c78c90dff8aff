"""Write the SRDF files beside the models of arms and tools, which list the pairs of links that need no monitoring.

    python robots/make_srdf.py config/dual_iiwa7.yaml FOLDER

``ARM.srdf`` lists pairs of an arm's own links, ``TOOL.srdf`` those of a tool, and ``TOOL_on_ARM.srdf`` those of both,
with the tool flat on the arm's last link. A flange between them has ``FLANGE_on_ARM.srdf`` and
``TOOL_on_FLANGE_on_ARM.srdf``.
"""

from __future__ import annotations

import argparse
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from itertools import combinations
from pathlib import Path

from q2r2_control.config.arms import ArmConfig, PoseConfig
from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.errors import ConfigError
from q2r2_control.robot.cell_parts import load_flange, load_model, name_of_stack
from q2r2_control.robot.compose import compose
from q2r2_control.robot.description import Description, parse_urdf
from q2r2_control.robot.pairs import CLEARANCE, ENVELOPE, link_of
from q2r2_control.robot.reachability import nearest_approaches, srdf_text
from q2r2_control.robot.robot import Robot

_SIDE = "left"

Disabled = tuple[str, str, str]  # Two links, and the reason why they need no monitoring.


def model_srdfs(config: Config, samples: int) -> dict[str, str]:
    """Return the text of every SRDF file by its name, for all models of ``config``'s arms.

    The existing files are not used. Neighbours, pairs that overlap at every posture, and pairs that stay more than
    :data:`CLEARANCE` apart are listed. Whether a pair stays apart is found from ``samples`` random postures and a
    descent from them. Raises :class:`ConfigError` for arms of one ``robot``, and for a flange without a model.
    """
    files: dict[str, str] = {}
    if config.robot is not None:
        raise ConfigError("robot: its arms have no models of their own; q2r2 check --pairs checks the whole cell")
    for side, arm in config.arms.items():
        model = load_model(arm, config.packages, f"arms.{side}")
        if arm.flange.thickness is not None:
            raise ConfigError(f"arms.{side}.flange: has no model; q2r2 check --pairs checks the whole cell")
        flange = load_flange(arm.flange, config.packages, f"arms.{side}.flange")
        tool = None if arm.tool.model is None else load_model(arm.tool, config.packages, f"arms.{side}.tool")
        stack = [part for part in (model, flange, tool) if part is not None]
        if f"{name_of_stack(stack)}.srdf" in files:
            continue
        layers = {link.get("name", ""): i for i, part in enumerate(stack) for link in part.urdf.findall("link")}
        disabled = _disabled(_alone(config, arm), _enveloped(tool), samples)
        comment = (
            f"Made by robots/make_srdf.py from {samples} random postures inside the joint limits. "
            f"Always: the shapes overlap at every posture, by construction. "
            f"Never: more than {1e3 * CLEARANCE:g} mm apart at every posture."
        )
        files[f"{model.stem}.srdf"] = srdf_text(model.name, comment, _of_layers(disabled, layers, {0}, 0))
        for i in range(1, len(stack)):
            name = name_of_stack(stack[: i + 1])
            files[f"{name}.srdf"] = srdf_text(name, comment, _of_layers(disabled, layers, set(range(i)), i))
        if tool is not None:
            within = _of_layers(disabled, layers, {len(stack) - 1}, len(stack) - 1)
            files[f"{tool.stem}.srdf"] = _tool_srdf(tool, within)
    return files


def _of_layers(disabled: list[Disabled], layers: Mapping[str, int], inner: set[int], outer: int) -> list[Disabled]:
    """Return the pairs of a link of the part ``outer`` and a link of the parts ``inner``. Part 0 is the arm."""
    found = []
    for pair in disabled:
        first, second = sorted(layers[link] for link in pair[:2])
        if first in inner and second == outer:
            found.append(pair)
    return found


def _alone(config: Config, arm: ArmConfig) -> Config:
    """Return a cell that consists only of ``arm``, which stands upright with its tool flat on its last link."""
    flat = {"link": None, "mount": PoseConfig()}
    tool = arm.tool if arm.tool.model is None else arm.tool.model_copy(update=flat)
    changes = {"tip": arm.named_tip, "mount": PoseConfig(), "tool": tool}
    alone = arm.model_copy(update=changes)
    return config.model_copy(update={"arms": {_SIDE: alone}, "obstacles": {}, "floor": None, "srdf": None})


def _disabled(config: Config, hidden: tuple[str, ...], samples: int) -> list[Disabled]:
    """Return the pairs of links of one arm and its tool that need no monitoring, sorted by reason."""
    cell, prefix = compose(config), f"{_SIDE}_"
    exclusions = [ET.Element("disable_default_collisions", link=prefix + link) for link in hidden]
    robot = Robot(parse_urdf(cell.urdf, cell.name), exclusions, cell.tool_frames, cell.home, cell.name, cell.parts)
    reasons = {frozenset(map(link_of, pair)): "Always" for pair in robot.ignored_pairs}
    for pair in nearest_approaches(robot, samples, 0, CLEARANCE):
        reasons[frozenset((pair.link_a, pair.link_b))] = "Never" if pair.nearest > CLEARANCE else "watched"
    links = dict.fromkeys(link_of(item.name) for item in robot.collision_model.geometryObjects)
    found = [
        (a.removeprefix(prefix), b.removeprefix(prefix), reasons.get(frozenset((a, b)), "Adjacent"))
        for a, b in combinations(links, 2)
        if not {a.removeprefix(prefix), b.removeprefix(prefix)} & set(hidden)
    ]
    return sorted((pair for pair in found if pair[2] != "watched"), key=lambda pair: pair[2])


def _enveloped(tool: Description | None) -> tuple[str, ...]:
    """Return the links of a tool whose shapes are replaced by its envelope."""
    if tool is None:
        return ()
    links = [link.get("name", "") for link in tool.urdf.findall("link") if link.find("collision") is not None]
    with_envelope = any(link.endswith(ENVELOPE) for link in links)
    return tuple(link for link in links if with_envelope and not link.endswith(ENVELOPE))


def _tool_srdf(tool: Description, disabled: list[Disabled]) -> str:
    comment = "Made by robots/make_srdf.py."
    if hidden := _enveloped(tool):
        comment += " The envelopes stand for hand and fingers, so that no distance depends on where the fingers are."
    return srdf_text(tool.name, comment, disabled, hidden)


def main() -> None:
    """Write the files of a cell's models, and replace existing ones."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", help="The YAML of a cell.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--samples", type=int, default=20_000, help="Number of random postures.")
    options = parser.parse_args()
    for name, text in model_srdfs(load_config(options.config), options.samples).items():
        (options.folder / name).write_text(text, encoding="utf-8")
        print(options.folder / name)


if __name__ == "__main__":
    main()
