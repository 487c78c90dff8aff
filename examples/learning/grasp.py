"""The whole chain in simulation: hands grasp a block 50 times, and a policy that is trained on that grasps it as well.

    .venv-lerobot/bin/python examples/learning/grasp.py FOLDER [--episodes 50] [--steps 4000] [--seeds 20]

The block lies elsewhere at each attempt, and the policy is told where: an ACT of lerobot, small and from scratch, on a
CPU. Its actions go through the door of policies, as those of the policy that it is compared with: the mean episode.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset, add_features
from lerobot.policies import make_pre_post_processors
from lerobot.policies.act.modeling_act import ACTPolicy

from q2r2_control import Pipeline, Robot, load_config
from q2r2_control.config.cell import Config
from q2r2_control.demo.assembly_tasks import TaskWatch, tasks_named
from q2r2_control.export.lerobot import SOURCES
from q2r2_control.inputs.assembly import GRASP
from q2r2_control.inputs.base import Input
from q2r2_control.inputs.policy import PolicyInput
from q2r2_control.inputs.scripted import ScriptedInput, in_sequence
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.recording.about import About
from q2r2_control.recording.recorder import Recorder
from q2r2_control.types import Array, Observation

TASK = tasks_named(["grasp"])[0]
BLOCK, SPREAD = "flat_block", 0.03  # how far from its place along x and y at most [m]
FPS, CHUNK = 10, 100  # actions a second, and in the one chunk that is the whole motion
PLACE = "observation.environment_state"  # lerobot's name; where the block lies, x y [m]
SMALL: dict[str, object] = {"chunk_size": CHUNK, "n_action_steps": CHUNK, "dim_model": 128, "n_heads": 4}
SMALL |= {"dim_feedforward": 512, "n_encoder_layers": 2, "use_vae": "false", "dropout": 0.0, "optimizer_lr": 5e-4}


class Learned:
    """Says the whole motion from what is seen at its begin."""

    rate = float(FPS)

    def __init__(self, folder: Path, place: Array) -> None:
        self._policy = ACTPolicy.from_pretrained(folder)
        self._before, self._after = make_pre_post_processors(self._policy.config, str(folder))
        self._place = place

    def __call__(self, seen: Observation) -> Array:
        state = np.hstack((seen.state.q, list(seen.openings.values())))
        batch = {"observation.state": state, PLACE: self._place}
        batch = {name: torch.tensor(values, dtype=torch.float32)[None] for name, values in batch.items()}
        with torch.inference_mode():
            actions = self._policy.predict_action_chunk(self._before(batch))[0]
            return self._after(actions).numpy()


def coarse(cell: Config) -> Config:
    """The cell with a slow control loop, 100 Hz: a tenth of the work."""
    control = cell.control.model_copy(update={"max_substep": 0.01})
    return cell.model_copy(update={"loop_rate_hz": 100.0, "control": control})


def place_of(seed: int) -> Array:
    """Of the block in the attempt with this ``seed``, from where the cell has it [m]."""
    return np.random.default_rng([seed, 7]).uniform(-SPREAD, SPREAD, 2)


def attempt(cell: Config, source: Input, place: Array, recorder: Recorder | None = None, seconds: float = 11.0) -> str:
    """Grasp the block at ``place``, from the cell's place on; returns what fell short, empty: it succeeded."""
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
    """Hands that tremble, and whose samples get lost and late, grasp the block wherever it lies."""
    failed = 0
    for seed in range(episodes):
        place = place_of(seed)
        trajectory = in_sequence([("grasp", GRASP.moved(*place))])
        hands = ScriptedInput(trajectory, human=True, seed=seed)
        with Recorder(folder, f"grasp-{seed:03}", waits=True) as recorder:
            failed += bool(attempt(cell, hands, place, recorder, trajectory.duration or 0.0))
    print(f"hands: {episodes - failed} of {episodes}", flush=True)


def export(recordings: Path, folder: Path) -> LeRobotDataset:
    """The dataset of q2r2 export lerobot, with where the block lay in each episode."""
    plain = folder.with_name("exported")
    command = [sys.executable, "-m", "q2r2_control", "export", "lerobot", recordings, "--output", plain]
    subprocess.run([*map(str, command), "--fps", str(FPS), "--trim", "--no-pictures"], check=True)
    dataset = LeRobotDataset("q2r2/grasp", root=plain)
    places = [json.loads(source["place"]) for source in json.loads((plain / SOURCES).read_text())]
    lengths = [episode["length"] for episode in dataset.meta.episodes]
    told = np.repeat(np.array(places, dtype=np.float32), lengths, axis=0)
    feature = {"dtype": "float32", "shape": (2,), "names": ["x", "y"]}
    return add_features(dataset, {PLACE: (told, feature)}, folder, "q2r2/grasp")


def train(dataset: Path, steps: int, folder: Path) -> Path:
    """By lerobot-train; returns the folder of the policy."""
    wanted = {"dataset.repo_id": "q2r2/grasp", "dataset.root": dataset, "output_dir": folder, "steps": steps}
    wanted |= {"policy.type": "act", "policy.device": "cpu", "policy.push_to_hub": "false", "save_freq": steps}
    wanted |= {"batch_size": 32, "num_workers": 0, "wandb.enable": "false", "log_freq": 200}
    wanted |= {f"policy.{name}": value for name, value in SMALL.items()}
    program = Path(sys.executable).with_name("lerobot-train")
    subprocess.run([str(program), *(f"--{name}={value}" for name, value in wanted.items())], check=True)
    return folder / "checkpoints/last/pretrained_model"


def mean_episode(dataset: LeRobotDataset) -> Array:
    """Actions (n, size) of the mean of all episodes."""
    table = dataset.hf_dataset.with_format("numpy")
    actions, frames = np.stack(table["action"]), np.array(table["frame_index"])
    return np.array([actions[frames == frame].mean(axis=0) for frame in range(frames.max() + 1)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    for name, value in (("episodes", 50), ("steps", 4000), ("seeds", 20)):
        parser.add_argument(f"--{name}", type=int, default=value)
    given = parser.parse_args()
    cell = coarse(load_config("config/dual_iiwa7.yaml"))
    record(cell, given.episodes, given.folder / "recordings")
    dataset = export(given.folder / "recordings", given.folder / "dataset")
    policy = train(given.folder / "dataset", given.steps, given.folder / "act")
    mean = mean_episode(dataset)
    done = {"ACT": 0, "mean episode": 0}
    for seed in range(given.seeds):
        place = place_of(1000 + seed)
        done["ACT"] += not (why := attempt(cell, PolicyInput(Learned(policy, place)), place))
        print(f"ACT, seed {seed}: {why or 'succeeded'}", flush=True)
        done["mean episode"] += not attempt(cell, PolicyInput(lambda seen: mean, rate=FPS), place)
    print(", ".join(f"{name}: {count} of {given.seeds}" for name, count in done.items()))
    sys.exit(done["ACT"] <= done["mean episode"])


if __name__ == "__main__":
    main()
