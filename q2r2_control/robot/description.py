"""Find and parse a robot description, and resolve its meshes.

The description is checked here, so that later code can rely on it: one tree, unique names, finite numbers, and meshes
that exist.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from q2r2_control.config.resources import find_resource
from q2r2_control.errors import ConfigError, RobotError
from q2r2_control.robot.followers import narrow_limits
from q2r2_control.robot.packages import expand_xacro, package_file
from q2r2_control.robot.urdf_forms import LimitNote, notes_on, scale_to_metres, unify
from q2r2_control.robot.urdf_parts import ATTRIBUTES, CONTINUOUS_RANGE

EXAMPLE_ROBOT_DATA = "example-robot-data:"
MJCF_ENDS = (".xml", ".mjcf")

_JOINT_TYPES = ("fixed", "revolute", "prismatic", "continuous", "planar", "floating")
_SHAPES = ("box", "cylinder", "sphere", "mesh")

# Text that urdfdom and Python read as the same number. urdfdom silently ignores text that it cannot read.
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?", re.ASCII)
_LARGEST = 1e20  # The square of this number is still finite.
_SHORTEST_AXIS = 1e-6
_VECTORS = ("xyz", "rpy", "size", "scale")
_POSITIVE = ("radius", "length", "size")
_SCALARS = {
    "cylinder": ("radius", "length"),
    "sphere": ("radius",),
    "mass": ("value",),
    "inertia": ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"),
    "limit": ("lower", "upper", "velocity", "effort", *ATTRIBUTES),
    "rotor": ("inertia", "gear"),
    "safety_controller": ("soft_lower_limit", "soft_upper_limit"),
    "mimic": ("multiplier", "offset"),
}


@dataclass(frozen=True, slots=True)
class Description:
    """One robot model: its URDF tree with absolute paths of meshes, its SRDF tree if it has one, and its file."""

    urdf: ET.Element
    srdf: ET.Element | None
    file: Path
    notes: tuple[LimitNote, ...] = ()

    @property
    def name(self) -> str:
        """The name in the URDF."""
        return self.urdf.get("name", self.stem)

    @property
    def stem(self) -> str:
        """The name of the file without its extensions."""
        return self.file.name.removesuffix(".xacro").removesuffix(".urdf")


def load_description(
    model: str, xacro_args: Mapping[str, object] | None = None, packages: Mapping[str, str] | None = None
) -> Description:
    """Find and parse ``model``: a file of robots/ without .urdf, ``example-robot-data:NAME``, or a path to a .urdf.

    A path may be ``package://NAME/...``. ``packages`` contains the folders of packages, by NAME. A file that ends in
    ``.xacro`` is expanded with ``xacro_args``. An SRDF with the same name beside the file belongs to it.

    Raises:
        ConfigError: If there is no such model.
        RobotError: If its files cannot be used.
    """
    packages = packages or {}
    if model.startswith(EXAMPLE_ROBOT_DATA):
        file, srdf_file = _example_robot(model.removeprefix(EXAMPLE_ROBOT_DATA))
    else:
        if model.startswith("package://"):
            file = package_file(model, None, packages)
        elif model.endswith((".urdf", ".xacro")):
            file = find_resource(model).resolve()
        else:
            file = _shipped_model(model)
        srdf_file = file.with_name(file.name.removesuffix(".xacro").removesuffix(".urdf") + ".srdf")
    if file.suffix == ".xacro":
        text: str | bytes = expand_xacro(file, xacro_args or {}, packages)
    elif xacro_args:
        raise ConfigError(f"{model}: xacro_args are for models that end in .xacro")
    else:
        text = read_xml(file)
    urdf = parse_urdf(text, str(file), file.parent, packages)
    scale_to_metres(urdf.iterfind("link/collision/geometry/mesh"))
    srdf = parse_srdf(read_xml(srdf_file), str(srdf_file)) if srdf_file is not None and srdf_file.is_file() else None
    return Description(urdf, srdf, file, tuple(notes_on(parse_srdf(text, str(file)))))


def _shipped_model(model: str) -> Path:
    """Return the URDF in robots/ that is called ``model``; raises :class:`ConfigError` if there is none.

    If ``model`` is no name but the path of a file of another kind, the error says which kinds are allowed.
    """
    try:
        return find_resource(f"robots/{model}.urdf")
    except ConfigError:
        if Path(model).name == model and not Path(model).suffix:
            raise
        if model.endswith(MJCF_ENDS):
            raise ConfigError("a cell has no MJCF; q2r2 new-cell writes a .urdf of it") from None
        kinds = f"a name in robots/, a path or package:// that ends in .urdf or .xacro, or {EXAMPLE_ROBOT_DATA}NAME"
        mjcf = f"q2r2 new-cell takes {' and '.join(MJCF_ENDS)} too"
        raise ConfigError(f"neither a name nor a model's file; allowed: {kinds}; {mjcf}") from None


def parse_urdf(
    text: str | bytes, where: str, folder: Path | None = None, packages: Mapping[str, str] | None = None
) -> ET.Element:
    """Parse a URDF, check that it is one tree with unique names and finite numbers, and make mesh paths absolute.

    Continuous joints become revolute joints with :data:`CONTINUOUS_RANGE` in each direction, because the controller's
    guarantees need a bound. If other joints mimic a joint, its limits are narrowed so that these joints keep their own
    limits.

    Args:
        text: The URDF.
        where: Names the text in errors.
        folder: The folder from which relative paths of meshes start.
        packages: Folders of the packages that ``package://`` names, by name.

    Raises:
        RobotError: If the text cannot be used.
    """
    # ``parse_srdf`` can parse a URDF too, because the root element of both formats is <robot>.
    root = parse_srdf(text, where)
    _check_numbers(root, where)
    unify(root, where)
    # If the parser ignored a shape, the distance from this body to others would not be kept.
    for link in root.findall("link"):
        for collision in link.findall("collision"):
            shapes = [shape.tag for shape in collision.findall("geometry/*")]
            if len(shapes) != 1 or shapes[0] not in _SHAPES:
                has = f"a collision of link {link.get('name')} has shapes {shapes}"
                raise RobotError(f"{where}: {has}; allowed: one of {', '.join(_SHAPES)}")
    links = _unique_names(root, "link", where)
    _unique_names(root, "joint", where)
    for joint in root.findall("joint"):
        _check_joint(joint, links, where)
        if joint.get("type") == "continuous":
            joint.set("type", "revolute")
            if (limit := joint.find("limit")) is None:
                limit = ET.SubElement(joint, "limit", velocity="0", effort="0")
            limit.set("lower", repr(-CONTINUOUS_RANGE))
            limit.set("upper", repr(CONTINUOUS_RANGE))
    LinkTree(root, where)
    narrow_limits(root.findall("joint"), f"{where}: ")
    for mesh in root.iter("mesh"):
        mesh.set("filename", _mesh_file(mesh.get("filename", ""), where, folder, packages or {}))
    return root


def parse_srdf(text: str | bytes, where: str) -> ET.Element:
    """Parse an SRDF; raises :class:`RobotError` with a text that begins with ``where``."""
    try:
        root = ET.fromstring(text)
    except (ET.ParseError, ValueError) as error:
        raise RobotError(f"{where}: not XML: {error}") from error
    if root.tag != "robot":
        raise RobotError(f"{where}: the root element is <{root.tag}>; a robot description starts with <robot>")
    return root


class LinkTree:
    """The tree of links and joints; raises :class:`RobotError` if the links do not form exactly one tree."""

    def __init__(self, robot: ET.Element, where: str) -> None:
        links = [link.get("name", "") for link in robot.findall("link")]
        self.joint_to: dict[str, ET.Element] = {}  # For each child link, the joint that connects it to its parent.
        for joint in robot.findall("joint"):
            child = joint_end(joint, "child")
            if child in self.joint_to:
                raise RobotError(f"{where}: link {child} hangs on two joints; a robot has to be one tree")
            self.joint_to[child] = joint
        self._carriers = {child: joint_end(joint, "parent") for child, joint in self.joint_to.items()}
        roots = [link for link in links if link not in self.joint_to]
        if len(roots) != 1:
            raise RobotError(f"{where}: expected one root link, found {len(roots)}: {', '.join(roots) or 'a loop'}")
        self.root = roots[0]
        for link in links:
            if self.path(link)[0] != self.root:
                raise RobotError(f"{where}: link {link} is part of a loop; a robot has to be one tree")

    def path(self, link: str) -> list[str]:
        """Return the links from the root to ``link``, with both of them."""
        path = [link]
        while path[-1] in self._carriers and len(path) <= len(self._carriers) + 1:
            path.append(self._carriers[path[-1]])
        return path[::-1]

    def movable(self) -> dict[str, ET.Element]:
        """Return all joints that are not fixed, by name."""
        return {joint.get("name", ""): joint for joint in self.joint_to.values() if joint.get("type") != "fixed"}

    def fixed_to(self, link: str) -> list[str]:
        """Return ``link`` and all links that are fixed to it."""
        found = [link]
        for carrier in found:  # The loop also visits the links that it adds to the list.
            found += [
                child
                for child, joint in self.joint_to.items()
                if joint.get("type") == "fixed" and self._carriers[child] == carrier
            ]
        return found

    def chain(self, link: str) -> list[ET.Element]:
        """Return the movable joints from the root to ``link``."""
        joints = [self.joint_to[name] for name in self.path(link)[1:]]
        return [joint for joint in joints if joint.get("type") != "fixed"]


def joint_end(joint: ET.Element, end: str) -> str:
    """Return the name of the joint's ``parent`` or ``child`` link; "" if it has none."""
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def joint_limits(joint: ET.Element) -> tuple[float, float]:
    """Return a joint's lower and upper position limit in the URDF [rad or m]; 0 for a limit that is not written."""
    limit = joint.find("limit")
    return (0.0, 0.0) if limit is None else (float(limit.get("lower", "0")), float(limit.get("upper", "0")))


def _check_numbers(root: ET.Element, where: str) -> None:
    for element in root.iter():
        scalars = _SCALARS.get(element.tag, ())
        for attribute, text in element.items():
            if attribute not in _VECTORS and attribute not in scalars:
                continue
            count = 3 if attribute in _VECTORS else 1
            parts = text.split()
            finite = all(_NUMBER.fullmatch(part) and abs(float(part)) < _LARGEST for part in parts)
            if len(parts) != count or not finite:
                allowed = f"{count} finite number(s)"
            elif attribute in _POSITIVE and min(map(float, parts)) <= 0:
                allowed = "more than 0"
            elif attribute == "value" and float(text) < 0:
                allowed = "0 or more"
            else:
                continue
            raise RobotError(f"{where}: <{element.tag}> has {attribute} = {text!r:.40}; allowed: {allowed}")


def _unique_names(root: ET.Element, tag: str, where: str) -> set[str]:
    names: set[str] = set()
    for element in root.findall(tag):
        name = element.get("name", "")
        if not name or name in names:
            raise RobotError(f"{where}: {tag} name {name!r} is {'given twice' if name else 'missing'}")
        names.add(name)
    return names


def _check_joint(joint: ET.Element, links: set[str], where: str) -> None:
    name, kind = joint.get("name"), joint.get("type")
    if kind not in _JOINT_TYPES:
        raise RobotError(f"{where}: joint {name} has type {kind!r}; allowed: {', '.join(_JOINT_TYPES)}")
    for end in ("parent", "child"):
        if joint_end(joint, end) not in links:
            raise RobotError(
                f"{where}: joint {name} has no {end} link among the model's links: {joint_end(joint, end)!r:.60}"
            )
    axis = joint.find("axis")
    direction = [float(part) for part in ("" if axis is None else axis.get("xyz", "")).split()]
    if kind != "fixed" and direction and math.hypot(*direction) < _SHORTEST_AXIS:
        raise RobotError(f"{where}: joint {name} has axis {direction}; allowed: a direction")
    lower, upper = joint_limits(joint)
    if kind in ("revolute", "prismatic") and lower > upper:
        limits = f"position limits {lower:g} .. {upper:g}"
        raise RobotError(f"{where}: joint {name} has {limits}; allowed: lower below upper")


def _example_robot(name: str) -> tuple[Path, Path | None]:
    from example_robot_data.robots_loader import ROBOTS, getModelPath

    if name not in ROBOTS:
        raise ConfigError(f"{EXAMPLE_ROBOT_DATA}{name}: no such robot; allowed: {', '.join(sorted(ROBOTS))}")
    loader = ROBOTS[name]
    if not loader.urdf_filename:
        raise ConfigError(f"{EXAMPLE_ROBOT_DATA}{name}: has no URDF; choose another robot or give a path")
    folder = Path(getModelPath(loader.path)) / loader.path
    srdf = folder / loader.srdf_subpath / loader.srdf_filename if loader.srdf_filename else None
    return folder / loader.urdf_subpath / loader.urdf_filename, srdf


def read_xml(file: Path) -> bytes:
    """Return the bytes of an XML file. They are not decoded, because the first line may name an encoding.

    Raises:
        RobotError: If the file cannot be read.
    """
    try:
        return file.read_bytes()
    except OSError as error:
        raise RobotError(f"{file}: cannot be read: {error}") from error


def _mesh_file(name: str, where: str, folder: Path | None, packages: Mapping[str, str]) -> str:
    if name.startswith("package://"):
        try:
            return str(package_file(name, folder, packages))
        except ConfigError as error:
            raise RobotError(f"{where}: mesh {error}") from error
    file = Path(name.removeprefix("file://"))
    file = file if file.is_absolute() or folder is None else folder / file
    if not file.is_file():
        raise RobotError(f"{where}: mesh {name!r:.200}: no such file")
    return str(file.resolve())
