"""The tasks of ``q2r2 demo`` as environments: ``gymnasium.make("q2r2_control.gym:q2r2/Stack-v0")``.

The import of this package registers the environments. The simulation is imported with the first environment.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from q2r2_control._lazy import lazy_exports
from q2r2_control.extras import importing

with importing("gym", "an environment"):
    import gymnasium
    from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

if TYPE_CHECKING:
    from q2r2_control.gym.task_env import TaskEnv as TaskEnv

_MODULES = {"TaskEnv": "task_env"}
__all__ = ["TASKS", "make_env", *_MODULES]
__getattr__, __dir__ = lazy_exports(__name__, _MODULES)

TASKS = ("carry", "clash", "grasp", "handover", "meet", "peg", "stack", "wipe")
_MOST_STEPS = 900  # An episode ends after this number of steps: half a minute at 30 Hz.

for _task in TASKS:
    gymnasium.register(
        f"q2r2/{_task.capitalize()}-v0",
        "q2r2_control.gym.task_env:TaskEnv",
        max_episode_steps=_MOST_STEPS,
        kwargs={"task": _task},
    )


def make_env(
    n_envs: int = 1,
    use_async_envs: bool = False,
    *,
    task: str = "stack",
    space: str = "action",
    cfg: object = None,
    **options: Any,
) -> AsyncVectorEnv | SyncVectorEnv:
    """Make ``n_envs`` environments of a task, each in a process of its own if ``use_async_envs`` is True.

    ``space`` and ``options`` go to :class:`q2r2_control.gym.task_env.TaskEnv`. By default an action has the
    numbers of a dataset's ``action``, which policies of lerobot return. ``cfg`` is the configuration that lerobot's
    EnvHub passes; it is not used.
    """
    made = [partial(gymnasium.make, f"{__name__}:q2r2/{task.capitalize()}-v0", space=space, **options)] * n_envs
    # The processes are spawned, because a forked process would share the graphics context of this process.
    return AsyncVectorEnv(made, context="spawn") if use_async_envs else SyncVectorEnv(made)
