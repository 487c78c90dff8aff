"""Two arms in public environments: our controller as the arms' joint controller, beside the environments' own.

    make arena  # an environment of its own with robosuite, where it runs this

The same scripted hands ask for the same tool poses, from what is true in the simulation. Successes are those of the
environment's own judge. Contacts, distances and limits are MuJoCo's, whatever a controller says of itself.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Protocol

import numpy as np
import pinocchio as pin
import typer

from arena_hands import Ask, Judge, ScriptedHands
from q2r2_control.cli.output import Json, print_progress, print_report
from q2r2_control.viewer.tables import figure_table

SEEDS = 50
LONGEST = 15.0  # of an episode [s]
COLUMNS = (
    *("task", "arms moved by", "of 50", "after [s]", "episodes with contact", "contacts", "nearest [mm]"),
    *("beyond a position limit", "by [rad]", "beyond a velocity limit", "velocity / limit"),
)
NO_ALOHA = (
    "gym-aloha is left out, since its model does not fit: its forearms turn by 10 Nm/rad against 30 Nm of friction, "
    "which follows no joint command, and its fingers of 60 by 90 mm are spheres of 43 mm to our controller, of which "
    "those of two hands do not get at one cube of 40 mm"
)
NOTES = (
    "of 50: successes by the environment's own judge, which ends the episode; after: median time of these",
    "contact: of geoms of one arm with geoms of the other, in MuJoCo; nearest: the same shapes, also where MuJoCo lets",
    "them pass through each other (robosuite's links), and 50 mm where they were never nearer",
    "beyond a limit: episodes in which a joint was, in any step of the physics; by, velocity / limit: the worst",
    "the hands of both know the objects' true places and ask for the same; none of them knows of the other arm",
    "q2r2 commands robosuite's JOINT_POSITION at 100 Hz, kp 3600; OSC_POSE is as robosuite ships it, at 20 Hz, kp 150",
)


class Cell(Protocol):
    """A task with one controller, an episode at a time."""

    PERIOD: float  # of the hands [s]
    judge: Judge

    def reset(self, seed: int) -> None: ...
    def tools(self) -> dict[str, pin.SE3]: ...
    def asks(self) -> Iterator[Ask]: ...
    def step(self, before: Mapping[str, pin.SE3], targets: Mapping[str, pin.SE3], closed: tuple[str, ...]) -> None: ...
    def succeeded(self) -> bool: ...


@dataclass(frozen=True)
class Episode:
    seed: int
    succeeded_after: float | None  # [s]
    contacts: int
    nearest: float  # [m]
    beyond_position: float  # [rad]
    breaks_position: bool
    velocity_ratio: float
    breaks_velocity: bool


def cells() -> Iterator[tuple[str, str, Callable[[], Cell]]]:
    """Tasks and controllers with what makes the cell; says on stderr what is left out, and why."""
    try:
        from arena_robosuite import CONTROLLERS, TASKS, RobosuiteCell
    except ImportError as error:
        print(f"robosuite is left out: {error}", file=sys.stderr)
    else:
        print("robosuite's IK_POSE is left out: it does not support robosuite's IIWA", file=sys.stderr)
        for task in TASKS:
            for controller in CONTROLLERS:
                yield task, controller, partial(RobosuiteCell, task, controller)
    print(NO_ALOHA, file=sys.stderr)


def play(cell: Cell, seed: int) -> Episode:
    """One episode, until it succeeds or the hands are done."""
    cell.reset(seed)
    hands = ScriptedHands(cell.asks(), cell.tools())
    after, steps = None, 0
    while after is None and not hands.done and steps * cell.PERIOD < LONGEST:
        before = dict(hands.targets)
        hands.advance(cell.tools(), cell.PERIOD)
        cell.step(before, hands.targets, hands.closed)
        steps += 1
        after = steps * cell.PERIOD if cell.succeeded() else None
    judge = cell.judge
    return Episode(
        seed=seed,
        succeeded_after=after,
        contacts=judge.contacts,
        nearest=judge.nearest,
        beyond_position=judge.beyond_position,
        breaks_position=judge.breaks_position,
        velocity_ratio=judge.velocity_ratio,
        breaks_velocity=judge.breaks_velocity,
    )


def row(task: str, controller: str, episodes: list[Episode]) -> tuple[str | int | float | None, ...]:
    """A line of the table."""
    times = [episode.succeeded_after for episode in episodes if episode.succeeded_after is not None]
    return (
        task,
        controller,
        len(times),
        float(np.median(times)) if times else None,
        sum(episode.contacts > 0 for episode in episodes),
        sum(episode.contacts for episode in episodes),
        1e3 * min(episode.nearest for episode in episodes),
        sum(episode.breaks_position for episode in episodes),
        max(0.0, *(episode.beyond_position for episode in episodes)),
        sum(episode.breaks_velocity for episode in episodes),
        max(episode.velocity_ratio for episode in episodes),
    )


def main(
    seeds: Annotated[int, typer.Option(min=1, help="Episodes of each, seeds from 0 on.")] = SEEDS,
    only: Annotated[str, typer.Option(help="Tasks and controllers whose names hold this.")] = "",
    json: Json = False,
) -> None:
    """Play the tasks with each controller, and print what happened to the arms."""
    data, rows = {}, []
    for task, controller, make in cells():
        name = f"{task} {controller}"
        if only not in name:
            continue
        cell, episodes = make(), []
        for seed in range(seeds):
            episodes.append(play(cell, seed))
            print_progress(f"{name}: {episodes[-1]}")
        data[name] = episodes
        rows.append(row(task, controller, episodes))
    columns = [column.replace("50", str(seeds)) for column in COLUMNS]
    print_report(data, (figure_table("arena", columns, rows, NOTES),) if rows else (), json)


if __name__ == "__main__":
    typer.run(main)
