"""Every shipped cell can start, and follows scripted hands in MuJoCo with the contract kept at every tick."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from q2r2_control.config.cell_file import load_config
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.supervision.preflight import preflight_faults
from tests.config.cell_files import SHIPPED
from tests.control.scenarios import into_the_table, overhead
from tests.support.driven import Driven
from tests.support.processes import Watch

FIRST = ("dual_iiwa7", "dual_panda")  # The slow tests examine the other cells.
FILES = [
    pytest.param(file, id=file.stem, marks=() if file.stem in FIRST else pytest.mark.slow)
    for file in sorted(SHIPPED.glob("*.yaml"))
]


@pytest.mark.slow
@pytest.mark.parametrize("file", FILES)
def test_a_shipped_cell_follows_hands_in_a_circle_and_keeps_the_contract_for_targets_out_of_reach(
    file: Path,
) -> None:
    # This is the lowest rate with one substep per tick. Fewer ticks make the test faster.
    config = load_config(file).model_copy(update={"loop_rate_hz": 500.0})
    pipeline = Pipeline.from_config(config, input=ScriptedInput.from_config(config, "circle"), plant="mujoco")
    assert preflight_faults(pipeline.robot, pipeline.controller.settings, pipeline.controller) == ()
    watch = Watch(pipeline)  # This listener checks the contract at every tick.
    summary = pipeline.run(2.8, realtime=False)
    heights = [[tool.translation[2] for tool in tick.tools.values()] for tick in watch.ticks]
    assert (np.ptp(heights, axis=0) > 0.02).all()
    assert summary.at_rest
    assert summary.uncertified_ticks == summary.rejected_targets == 0
    for arm in summary.arms.values():
        assert arm.position_error_mm_rms is not None
        assert arm.position_error_mm_rms < 10.0
        assert arm.slip_mm_max == 0.0
    for out_of_reach in (overhead, into_the_table):
        assert Driven(pipeline.controller, dt=0.005).drive(1.5, out_of_reach).report.certified
