"""How well do two arms in public environments work with our controller, and with the environments' own controllers?

    make arena  # makes a virtual environment with robosuite and runs this file there

The same scripted hands give all controllers the same target poses. The hands read the true state of the simulation.
The environment itself judges whether an episode succeeds. Contacts, distances and limits are measured in MuJoCo, and
not taken from the reports of a controller.
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
MAX_EPISODE_S = 15.0  # Longest duration of an episode [s].
COLUMNS = (
    *("task", "arms moved by", "of 50", "after [s]", "episodes with contact", "contacts", "nearest [mm]"),
    *("beyond a position limit", "by [rad]", "beyond a velocity limit", "velocity / limit"),
)
NO_ALOHA = (
    "gym-aloha is left out, because its model does not fit. Its forearm joints have a stiffness of 10 Nm/rad and "
    "a friction of 30 Nm, so they follow no joint command. Our controller encloses each finger of 60 by 90 mm in a "
    "sphere of 43 mm, and the spheres of two hands cannot reach the same cube of 40 mm."
)
NOTES = (
    "of 50: Number of successes. The environment's own judge decides, and a success ends the episode.",
    "after: Median time until success.",
    "contact: A geom of one arm touches a geom of the other arm in MuJoCo.",
    "nearest: Least distance between the same geoms, or 50 mm if they were never nearer. It includes geoms that "
    "MuJoCo lets pass through each other, such as robosuite's links.",
    "beyond a limit: Number of episodes in which a joint exceeded its limit in any step of the physics.",
    "by, velocity / limit: The largest values of all episodes.",
    "The hands of both controllers know the objects' true places and ask for the same poses.",
    "No hand knows where the other arm is.",
    "q2r2 commands robosuite's JOINT_POSITION controller at 100 Hz with kp 3600.",
    "OSC_POSE is used as robosuite ships it, at 20 Hz with kp 150.",
)


class Cell(Protocol):
    """A task of an environment, and the controller of its arms. A cell plays one episode after the other."""

    PERIOD: float  # Period of the hands' targets [s].
    judge: Judge

    def reset(self, seed: int) -> None: ...
    def tools(self) -> dict[str, pin.SE3]: ...
    def asks(self) -> Iterator[Ask]: ...
    def step(self, before: Mapping[str, pin.SE3], targets: Mapping[str, pin.SE3], closed: tuple[str, ...]) -> None: ...
    def succeeded(self) -> bool: ...


@dataclass(frozen=True)
class Episode:
    """The figures of one episode."""

    seed: int
    succeeded_after: float | None  # Time until success [s]; None if the episode did not succeed.
    contacts: int  # Number of times that the arms began to touch each other.
    nearest: float  # Least distance between the arms [m].
    beyond_position: float  # Largest angle by which a joint exceeded a position limit [rad].
    breaks_position: bool  # True if a joint exceeded a position limit.
    velocity_ratio: float  # Largest velocity of a joint, divided by its limit.
    breaks_velocity: bool  # True if a joint exceeded its velocity limit.


def cells() -> Iterator[tuple[str, str, Callable[[], Cell]]]:
    """Yield the name of a task, the name of a controller, and a function that makes a cell of both, for each such pair.

    If a task or a controller is left out, print the reason on stderr.
    """
    try:
        from arena_robosuite import CONTROLLERS, TASKS, RobosuiteCell
    except ImportError as error:
        print(f"robosuite is left out: {error}", file=sys.stderr)
    else:
        print("robosuite's IK_POSE is left out, because it does not support robosuite's IIWA.", file=sys.stderr)
        for task in TASKS:
            for controller in CONTROLLERS:
                yield task, controller, partial(RobosuiteCell, task, controller)
    print(NO_ALOHA, file=sys.stderr)


def play(cell: Cell, seed: int) -> Episode:
    """Play one episode until the task succeeds, the hands have no more targets, or :data:`MAX_EPISODE_S` is over."""
    cell.reset(seed)
    hands = ScriptedHands(cell.asks(), cell.tools())
    after, steps = None, 0
    while after is None and not hands.done and steps * cell.PERIOD < MAX_EPISODE_S:
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
    """Return the row of the printed table for one task and one controller."""
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
    seeds: Annotated[
        int, typer.Option(min=1, help="Number of episodes of each task and controller. Their seeds count from 0.")
    ] = SEEDS,
    only: Annotated[str, typer.Option(help="Play only tasks and controllers whose names contain this text.")] = "",
    json: Json = False,
) -> None:
    """Play the tasks with each controller, and print the successes, contacts, distances and exceeded limits."""
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
