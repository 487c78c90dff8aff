"""A run with its page. The run's time passes slowly, so that no hand and no page is late on a busy machine.

python -m tests.web.slow_run INPUT PORT PAUSE
"""

from __future__ import annotations

import json
import sys
import time

from q2r2_control.config.cell import Config
from q2r2_control.inputs.base import make_input
from q2r2_control.inputs.web import WebInput, web_cell
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.summary.tick import Tick
from q2r2_control.viewer.web import view
from tests.support.processes import cell

# If the hand of an engaged arm has been silent for _SILENT [s] of the run's time, each tick takes _STANDS [s].
_SILENT, _STANDS = 0.5, 1.0


class SlowTime:
    """The clock of the loop. A tick of 1 ms takes at least ``pause`` [s] of real time.

    While an engaged arm waits for a page that is busy drawing, the clock nearly stands still.
    """

    def __init__(self, pause: float) -> None:
        self._pause, self._now, self._heard = pause, 0.0, 0.0

    def __call__(self) -> float:
        return self._now

    def pass_by(self, tick: Tick) -> None:
        self._now = tick.now
        if tick.samples or not (tick.following and any(tick.engaged.values())):
            self._heard = tick.now
        time.sleep(self._pause if tick.now - self._heard < _SILENT else _STANDS)


def patient(config: Config) -> Config:
    """Return the cell with a long timeout of the gate, since a browser may be slow."""
    gate = config.teleop.gate.model_copy(update={"timeout": 2.0})
    return config.model_copy(update={"teleop": config.teleop.model_copy(update={"gate": gate})})


def main(source: str, port: int, pause: float) -> None:
    slow = SlowTime(pause)
    is_web = source == "web"
    config = web_cell(cell()) if is_web else cell()
    config = patient(config)
    hands = WebInput(slow) if is_web else make_input("scripted", config, trajectory=source)
    pipeline = Pipeline.from_config(config, input=hands, plant="kinematic")
    pipeline.listeners.append(slow.pass_by)
    view._PERIOD = 0.2  # The page is drawn seldom, because drawing takes long without a graphics card.
    with view.PageView("127.0.0.1", port) as page:
        print(f"page: {page.begin(pipeline, 'slow', False)}", file=sys.stderr, flush=True)
        print(json.dumps(pipeline.run(realtime=False).as_json()))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))
