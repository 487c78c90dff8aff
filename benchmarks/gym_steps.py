"""Steps per second of our environments, and of robosuite's two-arm environments with the same arms, in one run.

    make arena  # an environment of its own with robosuite, where it runs this

An environment is stepped by one process, with random actions and without pictures.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import typer

from q2r2_control.cli.output import Json, print_report
from q2r2_control.gym import TASKS
from q2r2_control.viewer.tables import figure_table

SECONDS, WARM = 20.0, 5  # of each environment, after so many steps
RATE = 20  # steps in a second of simulated time, robosuite's default
SHARE = 0.1  # of the largest action

Environment = tuple[str, Any, Callable[[], Any]]  # name, environment, and what draws an action


def of_ours() -> Iterator[Environment]:
    for task in TASKS:
        env = gymnasium.make(f"q2r2_control.gym:q2r2/{task.capitalize()}-v0", space="action.tool_delta", rate=RATE)
        yield f"q2r2 {task}", env, env.action_space.sample


def of_robosuite() -> Iterator[Environment]:
    try:
        import robosuite
    except ImportError as error:
        print(f"robosuite is left out: {error}", file=sys.stderr)
        return
    for name in ("TwoArmLift", "TwoArmHandover"):
        env = robosuite.make(
            name,
            robots=["IIWA", "IIWA"],
            has_renderer=False,
            has_offscreen_renderer=False,
            use_camera_obs=False,
            control_freq=RATE,
        )
        yield f"robosuite {name}", env, partial(np.random.default_rng(1).uniform, *env.action_spec)


def main(json: Json = False) -> None:
    """Print the steps per second of each environment."""
    data = {}
    for environments in (of_ours(), of_robosuite()):
        for name, env, action in environments:
            env.reset()
            for _ in range(WARM):
                env.step(SHARE * action())
            steps, began = 0, time.perf_counter()
            while (passed := time.perf_counter() - began) < SECONDS:
                if any(env.step(SHARE * action())[2:-1]):  # done, or terminated and truncated
                    env.reset()
                steps += 1
            data[name] = steps / passed
    rows = [(name, rate, rate / RATE) for name, rate in data.items()]
    print_report(data, (figure_table("environments", ("environment", "steps/s", "times real time"), rows),), json)


if __name__ == "__main__":
    typer.run(main)
