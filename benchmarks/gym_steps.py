"""How many steps per second do our environments and robosuite's two-arm environments make, with the same arms?

    make arena  # makes a virtual environment with robosuite and runs this file there

One process steps an environment with random actions and without pictures. The option ``--loop-rate 100`` slows down the
control loop of our environments.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Annotated, Any

import gymnasium
import numpy as np
import typer

from q2r2_control.cli.output import Json, print_report
from q2r2_control.gym import TASKS
from q2r2_control.viewer.tables import figure_table

DURATION_S, WARM_UP_STEPS = 20.0, 5  # Default measured time [s], and number of steps before it.
STEP_RATE_HZ = 20  # Steps per second of simulated time, which is robosuite's default [Hz].
ACTION_SHARE = 0.1  # Largest action, as a share of the largest allowed action.

Environment = tuple[str, Any, Callable[[], Any]]  # Name, environment, and a function that returns a random action.


def of_ours(loop_rate: float | None) -> Iterator[Environment]:
    for task in TASKS:
        name = f"q2r2_control.gym:q2r2/{task.capitalize()}-v0"
        env = gymnasium.make(name, space="action.tool_delta", rate=STEP_RATE_HZ, loop_rate=loop_rate)
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
            control_freq=STEP_RATE_HZ,
        )
        yield f"robosuite {name}", env, partial(np.random.default_rng(1).uniform, *env.action_spec)


LoopRate = Annotated[
    float | None, typer.Option(metavar="HZ", help="Rate of our control loop [Hz]. The default is the cell's.")
]
Seconds = Annotated[float, typer.Option(help="Duration for each environment [s].")]


def main(loop_rate: LoopRate = None, seconds: Seconds = DURATION_S, json: Json = False) -> None:
    """Print the steps per second and the processor time of a step for each environment."""
    data, computed = {}, {}
    for environments in (of_ours(loop_rate), of_robosuite()):
        for name, env, action in environments:
            env.reset()
            for _ in range(WARM_UP_STEPS):
                env.step(ACTION_SHARE * action())
            steps, began, computing = 0, time.perf_counter(), time.process_time()
            while (passed := time.perf_counter() - began) < seconds:
                # These items of the result are robosuite's done, or gymnasium's terminated and truncated.
                if any(env.step(ACTION_SHARE * action())[2:-1]):
                    env.reset()
                steps += 1
            data[name], computed[name] = steps / passed, 1e3 * (time.process_time() - computing) / steps
    rows = [(name, rate, rate / STEP_RATE_HZ, computed[name]) for name, rate in data.items()]
    columns = ("environment", "steps/s", "times real time", "CPU ms a step")
    print_report(data, (figure_table("environments", columns, rows),), json)


if __name__ == "__main__":
    typer.run(main)
