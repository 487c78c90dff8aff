"""A run that a headset's page drives. The run's time passes slowly, so that no hand is late on a busy machine.

python -m tests.web.headset_run PAUSE
"""

from __future__ import annotations

import json
import sys

from q2r2_control.inputs.webxr.webxr import WebXrInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.viewer.headset_view import HeadsetView
from tests.support.processes import cell
from tests.web.browser import PATIENCE
from tests.web.slow_run import SlowTime, patient


def main(pause: float) -> None:
    slow = SlowTime(pause)
    hands = WebXrInput(port=0, clock=slow, silence=PATIENCE, say=lambda line: print(line, file=sys.stderr, flush=True))
    pipeline = Pipeline.from_config(patient(WebXrInput.cell(cell())), input=hands, plant="mujoco")
    HeadsetView(hands, pipeline, recorded=False)
    pipeline.listeners.append(slow.pass_by)
    print(json.dumps(pipeline.run(realtime=False).as_json()))


if __name__ == "__main__":
    main(float(sys.argv[1]))
