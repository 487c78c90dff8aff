"""Other programs read exported files: robomimic reads HDF5, and LeRobot converts a dataset of v2.1 and reads it.

Run by ``make test-lerobot``, in an environment of its own.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("lerobot", reason="make test-lerobot installs it")
pytest.importorskip("robomimic", reason="make test-lerobot installs it")

from lerobot.datasets.lerobot_dataset import LeRobotDataset

try:
    from lerobot.scripts.convert_dataset_v21_to_v30 import convert_dataset

    OF_ALL = False  # True if the converter needs the folder that contains all datasets.
except ImportError:  # In lerobot 0.4, the converter is in another module.
    from lerobot.datasets.v30.convert_dataset_v21_to_v30 import convert_dataset

    OF_ALL = True
from robomimic.utils import obs_utils
from robomimic.utils.dataset import SequenceDataset

from q2r2_control.export.formats import ROBOMIMIC
from q2r2_control.export.lerobot import video_key
from tests.export.files import CAMERA
from tests.export.test_formats import EPISODES_FOR_ACT, export
from tests.export.test_lerobot_v21 import SEEN

FPS = 30


@pytest.mark.parametrize("cache", [None, "all"])
def test_robomimic_loads_every_step_with_its_pictures(cache: str | None, tmp_path: Path) -> None:
    made = export("hdf5", EPISODES_FOR_ACT, tmp_path, ["a", "b"])
    obs_utils.initialize_obs_utils_with_obs_specs({"obs": {"low_dim": ["qpos", "qvel"], "rgb": [CAMERA]}})
    loaded = SequenceDataset(
        str(made / ROBOMIMIC),
        obs_keys=("qpos", "qvel", CAMERA),
        dataset_keys=("actions", "rewards", "dones"),
        seq_length=2,
        hdf5_cache_mode=cache,
        load_next_obs=False,
    )
    assert (loaded.n_demos, len(loaded)) == (2, 65)
    step = loaded[41]
    np.testing.assert_array_equal(step["obs"]["qpos"], EPISODES_FOR_ACT[1].vectors["observation.state"][1:3])
    np.testing.assert_array_equal(step["actions"], EPISODES_FOR_ACT[1].vectors["action"][2:4])
    np.testing.assert_array_equal(step["obs"][CAMERA], list(EPISODES_FOR_ACT[1].cameras[CAMERA])[1:3])
    assert loaded[64]["dones"][-1] == 1.0


def test_lerobot_accepts_a_dataset_of_v21_and_reads_every_number_and_picture(tmp_path: Path) -> None:
    made = export("lerobot-v2.1", SEEN, tmp_path, ["1", "2", "3"])
    convert_dataset("made", root=made.parent if OF_ALL else made, push_to_hub=False)
    loaded = LeRobotDataset("made", root=made, delta_timestamps={"action": [0.0, 1 / FPS]}, video_backend="pyav")
    assert (loaded.num_episodes, loaded.num_frames, loaded.fps) == (3, 125, FPS)
    item = loaded[41]
    assert item["task"] == "circle"
    np.testing.assert_array_equal(item["action"].numpy(), SEEN[1].vectors["action"][1:3])
    for camera, name in (("front", "cam_high"), ("hand", "cam_left_wrist")):
        wanted = list(SEEN[1].cameras[camera])[1]
        assert np.abs(item[video_key(name)].numpy().transpose(1, 2, 0) * 255 - wanted).mean() < 6
    everything = np.concatenate([episode.vectors["observation.state"] for episode in SEEN])
    np.testing.assert_allclose(loaded.meta.stats["observation.state"]["mean"], everything.mean(axis=0), atol=1e-5)
