"""How long does it take from a controller's motion to the joint command, through a browser and its page?

Meta's iwer emulates a headset in Chromium. Everything else is as in q2r2 run --input webxr. A controller jumps by 5 mm
at random times. The latency is the time from a jump to the first joint command that differs from the command before the
jump. The page measures the time of the jump, and the run measures the time of the command, on the same computer. The
latency includes the wait for the headset's next frame, which takes half a frame on average.
"""

from __future__ import annotations

import sys
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from typer import Option, run

from q2r2_control.cli.output import DEMO_CONFIG, Json, print_report
from q2r2_control.config.cell_file import load_config
from q2r2_control.inputs.samples import HandsWatch
from q2r2_control.inputs.webxr.webxr import WebXrInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.summary.tick import Tick
from q2r2_control.types import Array
from q2r2_control.viewer.tables import record_table

CHROMIUM = "/usr/bin/chromium"
ARGUMENTS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
_MIN_MOTION = 1e-6  # A command differs from an earlier command if a joint differs by more than this [rad].
_MAX_LATENCY_S = 0.5  # The first command that differs is searched for during this time after a jump [s].

# A script for the page. Its function jump moves the left controller, and returns the wall clock's time of each jump and
# the mean time of a frame, both in [s].
EMULATED = """
const device = new IWER.XRDevice(IWER.metaQuest3);
device.installRuntime({ forceInstall: true });
device.stereoEnabled = false;
// A headset has a graphics card. Here a processor would draw, for 200 ms a frame, and every hand would wait for that.
for (const name of ["clear", "drawElements", "texImage2D", "generateMipmap"])
  WebGL2RenderingContext.prototype[name] = () => {};
for (const name of ["fillRect", "fillText", "drawImage"]) CanvasRenderingContext2D.prototype[name] = () => {};
Object.defineProperty(XRPose.prototype, "emulatedPosition", { get: () => false });
const frame = () => new Promise(requestAnimationFrame);
const pause = (time) => new Promise((done) => setTimeout(done, time));
window.engage = async () => {
  for (const value of [1, 0]) {
    device.controllers.left.updateButtonValue("x-button", value);
    await pause(200);
  }
};
window.jump = async (times) => {
  const began = performance.now();
  let frames = 0, on = true;
  const count = () => { frames += 1; if (on) requestAnimationFrame(count); };
  count();
  const moved = [];
  for (let index = 0; index < times; index++) {
    await pause(400 + 100 * Math.random());
    device.controllers.left.position.x += index % 2 ? -0.005 : 0.005;
    moved.push((performance.timeOrigin + performance.now()) / 1e3);
  }
  on = false;
  return { moved, frame: (performance.now() - began) / frames / 1e3 };
};
"""


@dataclass(frozen=True)
class PageLatency:
    """The latencies of all motions [ms]."""

    input: str
    motions: int  # Number of motions of the controller.
    followed: int  # Number of motions that a joint command followed in time.
    frame: float  # Mean time of a frame [ms].
    p50: float  # Median latency [ms].
    p99: float  # 99th percentile of the latency [ms].


class CommandTimes:
    """A listener that stores each command of the left arm, and its time by the wall clock."""

    def __init__(self, joints: Array) -> None:
        self._joints = joints
        self.times: list[float] = []
        self.commands: list[Array] = []

    def __call__(self, tick: Tick) -> None:
        self.times.append(time.time())
        self.commands.append(tick.command.q[self._joints])

    def delays(self, moved: list[float]) -> Array:
        """Return the time from each motion to the first command that differs from the command at its start [s].

        ``moved`` are the times of the motions by the wall clock [s]. Motions without such a command are left out.
        """
        times, commands = np.array(self.times), np.array(self.commands)
        found = []
        for began in moved:
            first, last = np.searchsorted(times, [began, began + _MAX_LATENCY_S])
            apart = np.abs(commands[first:last] - commands[first]).max(axis=1) > _MIN_MOTION
            if apart.any():
                found.append(times[first + int(apart.argmax())] - began)
        return np.array(found)


def main(
    jumps: Annotated[int, Option(min=10, help="Number of jumps of the controller.")] = 100,
    emulator: Annotated[Path, Option(help="The file of iwer, which make test-web fetches.")] = Path(
        ".venv/iwer/package/build/iwer.min.js"
    ),
    json: Json = False,
) -> None:
    """Measure the time from a controller's motion in a browser to the joint command."""
    from playwright.sync_api import sync_playwright  # The import is here, because only this function needs playwright.

    config = WebXrInput.cell(load_config(DEMO_CONFIG))
    # A browser without a graphics card sometimes pauses for longer than the default timeout. The arm would then stop.
    # With this longer timeout, such pauses are measured.
    gate = config.teleop.gate.model_copy(update={"timeout": _MAX_LATENCY_S})
    config = config.model_copy(update={"teleop": config.teleop.model_copy(update={"gate": gate})})
    source = WebXrInput(port=0, watch=HandsWatch(None, frame=False))
    pipeline = Pipeline.from_config(config, input=source, plant="kinematic")
    commands = CommandTimes(pipeline.robot.arms["left"].joints)
    pipeline.listeners.append(commands)
    thread = threading.Thread(target=pipeline.run)
    result: dict[str, Any] = {}
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, headless=True, args=ARGUMENTS)
        page = browser.new_page(viewport={"width": 240, "height": 160})
        page.add_init_script(f"{emulator.read_text()};{EMULATED}")
        thread.start()
        try:
            while source.url is None:
                time.sleep(0.1)
            page.goto(source.url)
            page.click("#immersive-vr")
            page.wait_for_timeout(1000.0)
            page.evaluate("engage()")
            result = page.evaluate("jumps => jump(jumps)", jumps)
            time.sleep(_MAX_LATENCY_S)
        finally:
            pipeline.stop()
            thread.join()
            browser.close()
    delays = 1e3 * commands.delays(result["moved"])
    if not len(delays):
        sys.exit("No motion reached the arm. Check that the arm was engaged.")
    p50, p99 = np.percentile(delays, [50, 99]).tolist()
    report = PageLatency("webxr", jumps, len(delays), 1e3 * result["frame"], p50, p99)
    print_report(asdict(report), (record_table("Latency through a page in Chromium [ms]", [report]),), json)


if __name__ == "__main__":
    run(main)
