"""``q2r2 new-cell``: write the YAML of a cell for new models, with home postures that pass ``q2r2 check``."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pinocchio as pin
import typer
from rich.console import Console
from typer import Argument, Exit, Option

from q2r2_control.cli.answers import RememberedAnswers
from q2r2_control.cli.cell_report import check_cell
from q2r2_control.cli.cell_yaml import commented_yaml
from q2r2_control.cli.model_arguments import SPEEDS, named_values, without_mjcf
from q2r2_control.cli.output import Json, as_json_text, counted, counting, say
from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config, parse_config
from q2r2_control.config.yaml_text import yaml_of
from q2r2_control.errors import ConfigError, Q2R2Error
from q2r2_control.process.folders import check_file
from q2r2_control.robot.compose import compose
from q2r2_control.robot.description import LinkTree, joint_limits, load_description
from q2r2_control.robot.floor import FLOOR
from q2r2_control.robot.home_search import find_home, mirrored_home
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.model_survey import CapsuleFit, capsule_fits, gripper_of, limits_lacking, tip_of, tips_by_side
from q2r2_control.robot.near_pairs import spreads_of
from q2r2_control.robot.pairs import CLEARANCE, link_of, links_moved_by, pair_names
from q2r2_control.robot.reachability import nearest_approaches, srdf_text
from q2r2_control.robot.robot import Robot
from q2r2_control.robot.stop_torque import stop_torques
from q2r2_control.robot.unchecked import links_of
from q2r2_control.robot.urdf_parts import mimic_of
from q2r2_control.types import Array
from q2r2_control.viewer.tables import figure_table, print_table

_ANSWERS = Path("new-cell.answers.json")  # The file that stores the answers, in the folder of the new cell.
_FITS = 8  # Largest number of rows in the printed table of capsules.
_LEAST_JOINTS = 3  # Least number of joints of an arm.
_OFF_FLOOR = 0.03  # For each link there must be a posture in which it is at least this far from the floor [m].
# If a pair's distance cannot exceed its kept distance by at least this, the pair gets a kept distance of its own [m].
_BARELY = 0.003

Model = Annotated[str | None, Option(metavar="MODEL", help="URDF, xacro, MJCF, package:// or example-robot-data:NAME.")]
Tip = Annotated[str | None, Option(metavar="LINK", help="Last link of that arm, where the model leaves a doubt.")]


@dataclass
class _Draft:
    """The unfinished cell: the data of its YAML, and what was found out about its models."""

    file: Path
    data: dict[str, Any]
    notes: list[str] = field(default_factory=list)  # Notes about guessed values.
    fits: dict[str, list[CapsuleFit]] = field(default_factory=dict)  # The capsules around the meshes of each model.
    always: list[tuple[str, str]] = field(default_factory=list)  # Pairs of links that overlap by construction.
    xacro_args: dict[str, str] = field(default_factory=dict)  # Arguments that every xacro model gets, by name.

    def part(self, model: str) -> dict[str, Any]:
        """Return the data of a model's block in the YAML. The model's mount is the world's origin until it is known."""
        args = {"xacro_args": self.xacro_args} if self.xacro_args and model.endswith(".xacro") else {}
        return {"model": model, **args, "mount": {"position": [0.0, 0.0, 0.0]}}

    def config(self) -> Config:
        return parse_config(yaml_of(self.data), self.file, self.file.absolute().parent)


def new_cell(
    name: Annotated[str, Argument(metavar="NAME", help="Name of the cell. NAME.yaml is written here.")],
    left: Model = None,
    right: Model = None,
    robot: Annotated[
        str | None, Option(metavar="MODEL", help="One model with both arms, instead of a model each.")
    ] = None,
    xacro_arg: Annotated[
        list[str] | None, Option(metavar="NAME=VALUE", help="Argument of the xacro models; may be repeated.")
    ] = None,
    left_tip: Tip = None,
    right_tip: Tip = None,
    distance: Annotated[float | None, Option(min=0, max=5, help="Distance between the bases of both arms [m].")] = None,
    height: Annotated[float | None, Option(min=-3, max=5, help="Height of the bases above the floor [m].")] = None,
    velocity: Annotated[
        float | None,
        Option(min=SPEEDS[0], max=SPEEDS[1], help="Speed limit of the joints of an MJCF, which has none [rad/s]."),
    ] = None,
    samples: Annotated[
        int, Option(min=100, help="Number of random postures in which pairs of links are looked at.")
    ] = 2000,
    yes: Annotated[bool, Option("--yes", help="Take the proposed answers and ask nothing.")] = False,
    json: Json = False,
) -> None:
    """Write the YAML of a cell for models of your own: tips, grippers, mounts, a home, pairs of links, accelerations.

    Exit code 1 if q2r2 check still finds faults in the cell, which are listed. Answers are kept in
    new-cell.answers.json until there are no faults, so that the next try offers them.
    """
    file, srdf = Path(f"{name}.yaml"), Path(f"{name}.srdf")
    if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
        raise ConfigError(f"NAME = {name!r:.60}: allowed: letters, digits, _ and -; the file is written here")
    for one in (file, srdf):
        if one.exists():
            goes_on = f"q2r2 check {file} is enough if only the model has changed" if file.exists() else "delete it"
            raise ConfigError(f"{one}: exists; allowed: another name; {goes_on}")
    check_file(file, "cell")
    if (robot is None) == (left is None and right is None):
        raise ConfigError("--left, --right or --robot: allowed: a model for each arm, or one that holds both")
    draft = _Draft(file, {"name": name}, xacro_args=named_values(xacro_arg or []))
    if xacro_arg and not any(model.endswith(".xacro") for model in (left, right, robot) if model is not None):
        raise ConfigError("--xacro-arg: allowed with a model that ends in .xacro")
    tips = {"left": left_tip, "right": right_tip}
    given = {side: model for side, model in (("left", left), ("right", right), ("robot", robot)) if model is not None}
    answers = RememberedAnswers(_ANSWERS, given, yes)
    if answers.any:
        say(f"the answers of the last try are offered, from {_ANSWERS}")
    models = without_mjcf(given, name, velocity, yes, answers)
    robot = models.get("robot")
    _survey(draft, dict.fromkeys(tips, robot) if robot else models, tips, shared=robot)
    _enclose_drawings(draft, yes)
    _mount(draft, distance, height, answers)
    _place(draft, answers)
    with counting() as progress:
        found = draft.config()
        cell = Robot.from_config(found)
        _limit_acceleration(draft, cell, found)
        approaches = nearest_approaches(cell, samples, 0, CLEARANCE, progress)
    # An overlapping pair of links gets into the SRDF only if none of their shapes form a monitored pair.
    watched = {frozenset(map(link_of, pair)) for pair in pair_names(cell.collision_model)}
    overlapping = ((link_of(a), link_of(b)) for a, b in cell.ignored_pairs)
    always = dict.fromkeys([*draft.always, *(links for links in overlapping if frozenset(links) not in watched)])
    never = [(pair.link_a, pair.link_b) for pair in approaches if pair.nearest > CLEARANCE]
    if always or never:
        comment = (
            f"Found by q2r2 new-cell in {samples} random postures: these links stay more than {1e3 * CLEARANCE:g} mm "
            "apart, or overlap by construction."
        )
        pairs = [*((a, b, "Always") for a, b in always), *((a, b, "Never") for a, b in never if (a, b) not in always)]
        srdf.write_text(srdf_text(name, comment, pairs), encoding="utf-8")
        draft.data["srdf"] = srdf.name
    file.write_text(commented_yaml(draft.data, cell), encoding="utf-8")
    result = check_cell(load_config(file))
    notes, faults = [*draft.notes, *result.notes], result.faults
    if json:
        print(as_json_text({"file": str(file), "capsules": draft.fits, "notes": notes, "faults": faults}))
    else:
        _print(draft, notes, faults)
    if not faults:
        answers.forget()
    raise Exit(1 if faults else 0)


def _survey(draft: _Draft, models: dict[str, str], tips: dict[str, str | None], shared: str | None) -> None:
    """Find the arms, tips and grippers in the models, and add them to the draft.

    If the models lack something, raise one :class:`ConfigError` that names everything that is missing.
    """
    described = {}
    for side, model in models.items():
        try:
            described[side] = load_description(model, draft.part(model).get("xacro_args"))
        except Q2R2Error as error:
            raise ConfigError(f"--{'robot' if shared else side} {model!r:.120}: {error}") from error
    trees = {side: LinkTree(description.urdf, models[side]) for side, description in described.items()}
    if shared is not None and not all(tips.values()):
        tips |= tips_by_side(trees["left"], "--left-tip and --right-tip")
    found = {side: tips[side] or tip_of(tree, f"--{side}-tip") for side, tree in trees.items()}
    chains, lacks = {}, []
    for side, tree in trees.items():
        if (tip := found[side]) not in (tree.root, *tree.joint_to):
            raise ConfigError(f"--{side}-tip {tip!r:.60}: no such link; links: {', '.join(tree.joint_to)}")
        chains[side] = tree.chain(tip)
        if len(chains[side]) < _LEAST_JOINTS:
            moves = f"joints that move {tip}: {len(chains[side])}"
            mimics = [
                f"{name} mimics {mimic[0]}" for name, joint in tree.movable().items() if (mimic := mimic_of(joint))
            ]
            but = f"; {', '.join(mimics):.200}, so that it ends the arm like a gripper's" if mimics else ""
            raise ConfigError(f"{models[side]!r:.120}: {moves}; allowed: an arm, of {_LEAST_JOINTS} or more{but}")
        if limits := limits_lacking(tree, tip):
            lacks.append(f"{models[side]}: {', '.join(limits)}")
    if lacks:
        raise ConfigError(f"{'; '.join(dict.fromkeys(lacks))}; to change: the <limit> of these joints in the model")
    if shared is not None:
        draft.data["robot"] = draft.part(shared)
    arms = draft.data["arms"] = {}
    for side, tree in trees.items():
        others = [joint for other in chains if other != side and shared for joint in chains[other]]
        names = {joint.get("name") for joint in others}
        joints = [joint for joint in chains[side] if joint.get("name") not in names]
        arms[side] = {} if shared else draft.part(models[side])
        arms[side] |= {"tip": found[side], "home": [float(np.mean(joint_limits(joint))) for joint in joints]}
        if gripper := gripper_of(described[side], tree, found[side]):
            arms[side]["gripper"] = gripper
            driven, key = ", ".join(gripper["joints"]), f"arms.{side}.gripper"
            taken = "are taken for joints" if len(gripper["joints"]) > 1 else "is taken for the joint"
            draft.notes.append(f"{side} arm: {driven} beyond its tip, {found[side]}, {taken} of a gripper, see {key}")
    # Fingers are left out. A finger's shape covers its whole stroke, so several capsules would hardly make it smaller.
    moved = {
        side: links_moved_by(tree, [joint.get("name", "") for joint in chains[side]])
        - links_moved_by(tree, arms[side].get("gripper", {}).get("joints", ()))
        for side, tree in trees.items()
    }
    capsules: dict[str, int] = {}
    for side, model in models.items():
        if model not in draft.fits:
            draft.fits[model] = capsule_fits(described[side], set[str]().union(*moved.values()))
        for fit in draft.fits[model]:
            if fit.capsules > 1 and fit.link in moved[side]:
                name = fit.link if shared else f"{side}_{fit.link}"
                capsules[name] = max(fit.capsules, capsules.get(name, 0))
    if capsules:
        draft.data["capsules"] = capsules


def _enclose_drawings(draft: _Draft, yes: bool) -> None:
    """If the user agrees, put capsules around the visual shapes of bodies that have no collision shape."""
    links = links_of(Robot.from_config(draft.config()))
    names = [link.name for link in links if link.is_unchecked and link.drawn and not link.shaped]
    question = f"watch {', '.join(names)} by capsules around their drawings"
    if not names or not (yes or typer.confirm(question, default=True)):
        return
    enclosed = []
    for name in names:
        before = draft.data.get("capsules", {})
        draft.data["capsules"] = before | {name: 1}
        try:
            Robot.from_config(draft.config())
            enclosed.append(name)
        except Q2R2Error as error:
            draft.notes.append(f"no capsule around the drawing of {name}: {error}")
            draft.data["capsules"] = before
    if enclosed:
        drawn = "drawn, without a collision shape, hence watched by capsules around the drawings"
        draft.notes.append(f"{', '.join(enclosed)}: {drawn}")


def _mount(draft: _Draft, distance: float | None, height: float | None, answers: RememberedAnswers) -> None:
    """Set the positions of the arms' bases from ``distance`` and ``height`` [m].

    Only the user knows these two numbers, so they are asked for if they are None.
    """
    arms, shared = draft.data["arms"], draft.data.get("robot")
    length = max(compose(draft.config()).arm_lengths().values())
    usual = round(min(max(length, 0.3), 1.0), 1)
    if distance is None:
        apart = len(arms) == 2 and shared is None
        distance = answers.ask("metres between the bases of both arms", usual) if apart else 0.0
    if height is None:
        stand = _stand(Robot.from_config(draft.config()), has_feet=shared is not None)
        height = answers.ask("height of the base above the floor in metres", stand)
    for side, part in {"robot": shared}.items() if shared is not None else arms.items():
        y = 0.0 if side == "robot" or len(arms) == 1 else distance / 2 if side == "left" else -distance / 2
        part["mount"]["position"] = [0.0, round(y, 4), height]


def _stand(robot: Robot, has_feet: bool) -> float:
    """Return the least height of the root link at which each link can get 0.03 m away from the floor [m].

    If the robot ``has_feet``, no fixed shape may be below the floor.
    """
    lowest = [0.0]
    # The collision shapes of the file are used, because a capsule around a pedestal reaches far below it.
    drawn = pin.buildGeomFromUrdfString(robot.model, robot.urdf, pin.GeometryType.COLLISION)
    for item in drawn.geometryObjects:
        if has_feet and item.parentJoint == 0 and link_of(item.name) != FLOOR:
            item.geometry.computeLocalAABB()
            box = item.geometry.aabb_local
            reach = np.abs(item.placement.rotation[2]) @ (box.max_ - box.min_) / 2
            lowest.append(float(item.placement.act((box.max_ + box.min_) / 2)[2] - reach))
    near = [pair for pair in pair_names(robot.collision_model) if FLOOR in map(link_of, pair)]
    farthest = min((most for _, most in spreads_of(robot, near).values()), default=math.inf)
    return math.ceil(100.0 * max(-min(lowest), _OFF_FLOOR - farthest)) / 100.0


def _place(draft: _Draft, answers: RememberedAnswers) -> None:
    """Find a home posture for each arm, and let the user change it.

    Pairs that can never get far enough apart get their own kept distance. If they overlap, they are not monitored.
    """
    config = draft.config()
    robot = Robot.from_config(config)
    least = config.control.min_distance
    near_by_construction = []  # Pairs of links of one arm, and pairs with a fixed link other than the floor.
    for pair in pair_names(robot.collision_model):
        links = link_of(pair[0]), link_of(pair[1])
        one, other = (robot.roles[link].arms for link in links)
        if one & other or (not (one and other) and FLOOR not in links):
            near_by_construction.append(pair)
    pairs = []
    for links, (nearest, farthest) in spreads_of(robot, near_by_construction).items():
        if farthest < least + _BARELY and nearest > 1e-3:
            pairs.append({"pair": list(links), "distance": math.floor(1e3 * nearest) / 1e3})
        elif farthest < least + _BARELY:
            draft.always.append(links)
    if pairs:
        draft.data["control"] = {"pairs": pairs}
    kept = kept_distances(robot, draft.config().control).values
    names = [(link_of(a), link_of(b)) for a, b in pair_names(robot.collision_model)]
    kept[[names_of in draft.always for names_of in names]] = -np.inf
    q = robot.home.copy()
    placed: list[str] = []
    for side, arm in robot.arms.items():
        model = draft.data["arms"][side].get("model")
        twins = [other for other in placed if draft.data["arms"][other].get("model") == model]
        like = q[robot.arms[twins[0]].joints] if twins else None
        if twins and "robot" in draft.data:
            like = mirrored_home(robot, side, twins[0], q)
        found: Array = find_home(robot, side, q, kept, placed, like).round(3)
        text = " ".join(f"{value:g}" for value in found)
        question = f"home of the {side} arm, found; or yours in radians"
        answer = answers.ask(question, text)
        try:
            home = [float(part) for part in re.split(r"[,\s]+", answer.strip(" []"))]
        except ValueError:
            answers.drop(question)
            raise ConfigError(f"home of the {side} arm = {answer!r:.80}: allowed: {len(found)} numbers") from None
        draft.data["arms"][side]["home"] = home
        q[arm.joints] = home if len(home) == len(found) else found
        placed.append(side)


def _limit_acceleration(draft: _Draft, robot: Robot, config: Config) -> None:
    """If the models have no acceleration limits, set limits with which a full stop keeps the torque limits."""
    cap = config.control.acceleration_limit
    if np.isfinite(robot.acceleration_limit).all():
        return
    share = min(stop.bearable for stop in stop_torques(robot, robot.capped_acceleration(cap)))
    if 0.05 < share < 1.0:
        draft.data.setdefault("control", {})["acceleration_limit"] = math.floor(10.0 * cap * share) / 10.0


def _print(draft: _Draft, notes: Sequence[str], faults: Sequence[str]) -> None:
    console = Console(highlight=False, soft_wrap=True)
    for model, fits in draft.fits.items():
        rows = (
            (
                *(fit.link, 1e3 * fit.radius, 1e3 * fit.length, 1e3 * fit.beyond, 100 * fit.wasted),
                *((fit.capsules, 100 * fit.then_wasted) if fit.capsules > 1 else ("", "")),
            )
            for fit in fits[:_FITS]
        )
        sizes = ("radius [mm]", "length [mm]", "beyond the mesh [mm]")
        columns = ("link", *sizes, "empty [%]", "better", "then empty [%]")
        if fits:
            meshes = counted(len(fits), "mesh", "meshes")
            title = f"{model}: capsules around {meshes}, each with the whole mesh inside; the worst first"
            notes_on_columns = (
                "beyond the mesh: how far a capsule stands out; empty: its share that holds none of the mesh; better:",
                "the number of smaller capsules that the cell gets instead; then empty: the share with these",
            )
            print_table(figure_table(title, columns, rows, notes_on_columns), console)
    for note in notes:
        say(f"NOTE {note}", console)
    for fault in faults:
        say(f"FAULT {fault}", console, "red")
    done = "left to do: each FAULT above" if faults else "the check finds no fault"
    say(f"{draft.file}: {done}; next: q2r2 {'check' if faults else 'run'} {draft.file}", console)
