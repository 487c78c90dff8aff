"""The bench of the loop times the product's own tick, also while it is recorded."""

from __future__ import annotations

import json

import numpy as np
import pytest

from q2r2_control.benchmark.loop_times import CASES, _p99_ratio, run_loop_bench
from q2r2_control.benchmark.stage_clock import STAGES
from q2r2_control.config.cameras import CameraConfig
from q2r2_control.config.cell import load_config
from q2r2_control.errors import ConfigError

pytestmark = pytest.mark.slow

CONFIG = load_config("config/dual_iiwa7.yaml")


def test_it_times_the_loop_s_own_ticks_of_every_plant_and_mode() -> None:
    report = run_loop_bench(CONFIG, 100, paced=False, record=True)
    assert [(row.plant, row.mode) for row in report.rows] == [(plant, str(mode)) for plant, mode in CASES]
    for row in report.rows:
        assert tuple(stage.stage for stage in row.stages) == STAGES
        assert (row.ticks, row.rounds) == (100, 10)
        # Each stage is called at every tick.
        assert all(0.0 < stage.median_us <= stage.p99_us for stage in row.stages)
        assert 0.0 < row.to_command.median_us < row.without_physics.median_us <= row.without_physics.p99_us
        assert 0.0 < row.back_to_back.median_us <= row.back_to_back.p99_us
        cost = row.recording
        assert cost is not None
        assert 0.0 < cost.to_command.median_us < cost.without_physics.median_us
        for ratio in (cost.p99_ratio, cost.to_command_p99_ratio):
            assert 0.0 < ratio.low <= ratio.high
    json.dumps(report.as_json(), allow_nan=False)


def test_pictures_are_taken_where_mujoco_is() -> None:
    camera = CameraConfig(position=(1.9, 0.0, 1.0), look_at=(0.4, 0.0, 0.3), width=64, height=48, rate=10.0)
    report = run_loop_bench(CONFIG.model_copy(update={"cameras": {"front": camera}}), 100, paced=False, record=True)
    assert all(row.recording is not None for row in report.rows)


def test_too_few_ticks_are_refused() -> None:
    with pytest.raises(ConfigError, match="ticks = 99: allowed: 100 or more"):
        run_loop_bench(CONFIG, 99)


def test_the_ratio_of_two_p99_is_found_although_the_machine_s_speed_changes_from_pair_to_pair() -> None:
    random = np.random.default_rng(1)
    speeds = random.uniform(0.7, 1.4, 10)
    plain = [speed * random.exponential(1.0, 3000) for speed in speeds]
    recorded = [1.2 * speed * random.exponential(1.0, 3000) for speed in speeds]
    value, low, high = _p99_ratio(recorded, plain)
    assert low <= value <= high
    assert low < 1.2 < high
    assert high - low < 0.1, "while p99 of each alone differ by a factor of two"
