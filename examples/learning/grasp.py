"""Train a policy in simulation: hands grasp a block 50 times, and a policy that learns from them grasps it, too.

    .venv-lerobot/bin/python examples/learning/grasp.py FOLDER [--episodes 50] [--steps 3000] [--seeds 20]

The block lies at a different position in each attempt, and the policy gets this position as an input. The policy is a
small ACT of lerobot, which is trained from scratch on a CPU. It is compared with a second policy, which always plays
the mean of all episodes. The actions of both policies go through the same policy input of the control loop.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.datasets.dataset_tools import add_features
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors

from q2r2_control import ActionSpace, Array, Config, Input, Observation, Pipeline, PolicyInput, Robot, load_config
from q2r2_control.demo import TaskWatch, tasks_named
from q2r2_control.export import SOURCES
from q2r2_control.inputs import ScriptedInput, trajectory_named
from q2r2_control.plants import MujocoPlant
from q2r2_control.recording import About, Recorder

TASK = tasks_named(["grasp"])[0]
BLOCK, MAX_DISPLACEMENT = "flat_block", 0.03  # Block, and its largest displacement along x and y [m].
FPS, CHUNK = 10, 100  # Actions per second [Hz], and actions in a chunk. One chunk is the whole motion.
PLACE = "observation.environment_state"  # lerobot's name for the input with the block's displacement, x y [m].
STATE, ACTION = "observation.state", "action"
ACT_SETTINGS: dict[str, Any] = {"dim_model": 64, "n_heads": 4, "dim_feedforward": 256, "n_encoder_layers": 2}
ACT_SETTINGS |= {"use_vae": False, "dropout": 0.0, "chunk_size": CHUNK, "n_action_steps": CHUNK, "device": "cpu"}
BATCH_SIZE, LEARNING_RATE = 16, 1e-3  # Batch size and learning rate.
# Each number of an action is divided by its standard deviation, but at least by this [m or 1]. Numbers that vary less
# contain mostly tremor, which the policy must not learn.
MIN_DEVIATION = 0.02
MIN_SUCCESS_SHARE = 0.5  # Least share of attempts that must succeed.


class Whole:
    """A policy that computes the whole motion at its first call. Later calls return the part that is still to come."""

    space, rate = ActionSpace.TOOL, float(FPS)

    def __init__(self, motion: Callable[[Observation], Array]) -> None:
        self._say = motion
        self._begun: tuple[float, Array] | None = None

    def __call__(self, seen: Observation) -> Array:
        self._begun = start, motion = self._begun or (seen.time, self._say(seen))
        return motion[min(round((seen.time - start) * FPS), len(motion) - 1) :]


def learned(folder: Path, place: Array) -> Callable[[Observation], Array]:
    """Return a function that computes a motion by the policy in ``folder``. The block is displaced by ``place`` [m]."""
    policy = ACTPolicy.from_pretrained(folder)
    before, after = make_pre_post_processors(policy.config, str(folder))

    def motion(seen: Observation) -> Array:
        state = np.hstack((seen.state.q, list(seen.openings.values())))
        batch = {
            name: torch.tensor(values, dtype=torch.float32)[None] for name, values in ((STATE, state), (PLACE, place))
        }
        with torch.inference_mode():
            return np.asarray(after(policy.predict_action_chunk(before(batch))[0]))

    return motion


def coarse(cell: Config) -> Config:
    """Return the cell with a slow control loop of 100 Hz, which needs a tenth of the computing time."""
    control = cell.control.model_copy(update={"max_substep": 0.01})
    return cell.model_copy(update={"loop_rate_hz": 100.0, "control": control})


def place_of(seed: int) -> Array:
    """Return the displacement (2,) [m] of the block in the attempt with this ``seed``."""
    return np.random.default_rng([seed, 7]).uniform(-MAX_DISPLACEMENT, MAX_DISPLACEMENT, 2)


def attempt(cell: Config, source: Input, place: Array, recorder: Recorder | None = None, seconds: float = 11.0) -> str:
    """Try to grasp the block, displaced by ``place`` (2,) [m]; returns why this failed, or "" after success."""
    block = cell.mujoco.objects[BLOCK]
    x, y, z = block.position
    moved = block.model_copy(update={"position": (x + place[0], y + place[1], z)})
    objects = cell.mujoco.objects | {BLOCK: moved}
    cell = cell.model_copy(update={"mujoco": cell.mujoco.model_copy(update={"objects": objects})})
    robot = Robot.from_config(cell)
    plant = MujocoPlant(robot, cell)
    pipeline = Pipeline(cell, robot, source, plant)
    pipeline.listeners.append(watch := TaskWatch([TASK], plant, robot, cell))
    if recorder is not None:
        notes = {"task": TASK.about, "place": json.dumps(place.tolist())}
        recorder.begin(About.of(pipeline, False, notes), robot)
        pipeline.listeners.append(recorder)
    pipeline.run(seconds, realtime=False)
    reason = watch.results()[0].reason
    if recorder is not None:
        recorder.success = not reason
    return reason


def record(cell: Config, episodes: int, folder: Path) -> None:
    """Record scripted hands that grasp the block. They tremble, and some of their samples are late or lost."""
    failed = 0
    for seed in range(episodes):
        place = place_of(seed)
        trajectory = trajectory_named(TASK.name, (place[0], place[1]))
        hands = ScriptedInput(trajectory, human=True, seed=seed)
        with Recorder(folder, f"grasp-{seed:03}", waits=True) as recorder:
            failed += bool(attempt(cell, hands, place, recorder, trajectory.duration or 0.0))
    print(f"hands: {episodes - failed} of {episodes}", flush=True)


def export(recordings: Path, folder: Path) -> LeRobotDataset:
    """Return a dataset made by q2r2 export lerobot, with the block's displacement in each episode added."""
    plain = folder.with_name("exported")
    command = [sys.executable, "-m", "q2r2_control", "export", "lerobot", recordings, "--output", plain]
    subprocess.run([*map(str, command), "--fps", str(FPS), "--trim", "--no-pictures"], check=True)
    dataset = LeRobotDataset("q2r2/grasp", root=plain)
    places = [json.loads(source["place"]) for source in json.loads((plain / SOURCES).read_text())]
    lengths = [episode["length"] for episode in dataset.meta.episodes]
    told = np.repeat(np.array(places, dtype=np.float32), lengths, axis=0)
    feature = {"dtype": "float32", "shape": (2,), "names": ["x", "y"]}
    return add_features(dataset, {PLACE: (told, feature)}, folder, "q2r2/grasp")


def train(dataset: LeRobotDataset, steps: int, folder: Path) -> Path:
    """Train an ACT policy, and return the folder into which it is saved.

    All data is in memory, because lerobot's data loader would take longer than the policy itself.
    """
    actions = actions_of(dataset)
    columns = {name: torch.from_numpy(column(dataset, name)) for name in (STATE, PLACE)}
    columns[ACTION] = torch.from_numpy(actions)
    sizes = {name: tuple(values.shape[1:]) for name, values in columns.items()}
    seen = {STATE: PolicyFeature(FeatureType.STATE, sizes[STATE]), PLACE: PolicyFeature(FeatureType.ENV, sizes[PLACE])}
    config = ACTConfig(
        input_features=seen, output_features={ACTION: PolicyFeature(FeatureType.ACTION, sizes[ACTION])}, **ACT_SETTINGS
    )
    policy = ACTPolicy(config)
    scale = {"mean": actions.mean(axis=0), "std": np.maximum(actions.std(axis=0), MIN_DEVIATION)}
    stats = dataset.meta.stats | {ACTION: scale}
    before, after = make_pre_post_processors(config, dataset_stats=stats)
    ends = torch.from_numpy(np.repeat(dataset.meta.episodes["dataset_to_index"], dataset.meta.episodes["length"]))
    # The policy is only called in the first second of an episode, so it learns only from the frames of this second.
    begins = torch.from_numpy(np.flatnonzero(column(dataset, "frame_index") < FPS))
    optimizer = torch.optim.AdamW(policy.parameters(), LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for step in range(steps):
        frames = begins[torch.randint(len(begins), (BATCH_SIZE,))]
        ahead = frames[:, None] + torch.arange(CHUNK)
        over = ahead >= ends[frames, None]
        batch = {name: columns[name][frames] for name in seen}
        batch |= {ACTION: columns[ACTION][ahead.clamp(max=ends[frames, None] - 1)], f"{ACTION}_is_pad": over}
        loss, _ = policy.forward(before(batch))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if step % (steps // 10) == 0:
            print(f"step {step}: loss {loss.item():.4f}", flush=True)
    for part in (policy, before, after):
        part.save_pretrained(folder)
    return folder


def actions_of(dataset: LeRobotDataset) -> Array:
    """Return the dataset's actions: target poses of the tools, and openings of both grippers.

    If joint positions were learned instead, their errors would add up along an arm.
    """
    return np.hstack((column(dataset, ActionSpace.TOOL), column(dataset, ACTION)[:, -2:]))


def column(dataset: LeRobotDataset, name: str) -> Array:
    return np.stack(dataset.hf_dataset.with_format("numpy")[name])


def mean_episode(dataset: LeRobotDataset) -> Array:
    """Return the mean actions of all episodes (n, size). n is the number of actions in a chunk of the policy."""
    actions, frames = actions_of(dataset), column(dataset, "frame_index")
    return np.array([actions[frames == frame].mean(axis=0) for frame in range(CHUNK)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    for name, value in (("episodes", 50), ("steps", 3000), ("seeds", 20)):
        parser.add_argument(f"--{name}", type=int, default=value)
    given = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(1)  # The policy is too small to gain from more threads.
    cell = coarse(load_config("config/dual_iiwa7.yaml"))
    record(cell, given.episodes, given.folder / "recordings")
    dataset = export(given.folder / "recordings", given.folder / "dataset")
    policy = train(dataset, given.steps, given.folder / "act")
    mean = mean_episode(dataset)
    done = {"ACT": 0, "mean episode": 0}
    for seed in range(given.seeds):
        place = place_of(1000 + seed)
        done["ACT"] += not (why := attempt(cell, PolicyInput(Whole(learned(policy, place))), place))
        print(f"ACT, seed {seed}: {why or 'succeeded'}", flush=True)
        done["mean episode"] += not attempt(cell, PolicyInput(Whole(lambda seen: mean)), place)
    print(", ".join(f"{name}: {count} of {given.seeds}" for name, count in done.items()))
    sys.exit(done["ACT"] < max(MIN_SUCCESS_SHARE * given.seeds, done["mean episode"] + 1))


if __name__ == "__main__":
    main()
