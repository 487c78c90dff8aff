"""Whatever a hand sends, the loop keeps every limit, raises nothing, and follows what is valid."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.types import QUEST_CONTROLS, SIDES, HandSample
from tests.support.watch import Watch, cell, speed

pytestmark = pytest.mark.slow


class HostileInput:
    """A hand that moves normally and presses buttons, with invalid samples in between."""

    controls = QUEST_CONTROLS

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self._source = ScriptedInput("circle", human=True, seed=seed, frequency_hz=1.0)
        self.connected = True
        self.start, self.close, self.send_haptic = self._source.start, self._source.close, self._source.send_haptic

    def poll(self, now: float) -> list[HandSample]:
        random = self._random
        self.connected = bool(random.random() > 1e-3)
        pressed = now % 0.6 < 0.2
        samples = [
            replace(sample, inputs=replace(sample.inputs, button_lower=pressed)) for sample in self._source.poll(now)
        ]
        if samples and random.random() < 0.05:
            samples.append(self._invalid(samples[-1]))
        if samples and random.random() < 0.002:
            samples += [self._invalid(samples[0]) for _ in range(1000)]
        return samples

    def _invalid(self, sample: HandSample) -> HandSample:
        random, bad = self._random, (np.nan, np.inf, -np.inf, 1e308, -1e-308, 0.0)
        changes: list[dict[str, object]] = [
            {"position": np.array(random.choice(bad, 3))},
            {"position": sample.position + random.normal(0.0, 10.0 ** random.uniform(-4, 3), 3)},
            {"position": np.zeros(random.integers(0, 5))},
            {"quaternion": np.zeros(4)},
            {"quaternion": np.array(random.choice(bad, 4))},
            {"quaternion": random.normal(0.0, 1.0, 4)},
            {"hand": str(random.choice(["middle", "", "LEFT", "right"]))},
            {"pose_stamp": float(random.choice([np.nan, np.inf, -np.inf, 1e300]))},
            {"pose_stamp": sample.pose_stamp - random.exponential(1.0)},
            {"pose_stamp": sample.pose_stamp + random.exponential(1.0)},
            {"inputs_stamp": float(random.choice([np.nan, np.inf, -np.inf, -1e300]))},
            {"inputs": replace(sample.inputs, button_lower=bool(random.random() < 0.5), press_index=np.nan)},
            {"inputs": replace(sample.inputs, button_lower=True, button_upper=True)},
        ]
        return replace(sample, **changes[random.integers(len(changes))])  # type: ignore[arg-type]


def test_ten_thousand_ticks_of_hostile_samples_break_no_limit_and_raise_nothing() -> None:
    loop = Pipeline.from_config(cell(), input=HostileInput(7), plant="kinematic")
    watch = Watch(loop)
    summary = loop.run(10.0, realtime=False)
    assert summary.ticks == len(watch.ticks) >= 10_000
    json.dumps(summary.as_json(), allow_nan=False)
    assert summary.at_rest
    assert len(watch.engagements("left")) >= 5, "valid samples are followed"
    assert max(map(speed, watch.ticks)) > 0.3
    assert {event.kind for event in summary.events} >= {
        *("pose_unusable", "hand_jumped", "connection_lost", "alignment_chord")
    }
    for arm in SIDES:
        for index in watch.engagements(arm):
            tick = watch.ticks[index]
            pose = tick.targets[arm].pose
            assert pose is not None
            assert np.linalg.norm(pose.translation - tick.tools[arm].translation) < 1e-6
