"""How long from the motion of a controller to the command of its arm's joints, through a browser and its page?

A headset is emulated in Chromium (Meta's iwer), and the run is the one of q2r2 run --input webxr. A controller jumps by
5 mm now and then, and the page's clock says when. Joint commands are watched until they differ. Both clocks are those
of one computer. The time includes waiting for the next frame of the headset, half a frame in the mean.
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
from q2r2_control.config.cell import load_config
from q2r2_control.inputs.samples import HandsWatch
from q2r2_control.inputs.webxr.webxr import WebXrInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.summary.tick import Tick
from q2r2_control.types import Array
from q2r2_control.viewer.tables import record_table

CHROMIUM = "/usr/bin/chromium"
ARGUMENTS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
_MOVED = 1e-6  # a command that differs by more has moved [rad]
_LATEST = 0.5  # behind a jump [s]

# Both hands jump; returns when, by the clock on the wall, and how long a frame takes, both in [s].
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
    """Times are in [ms]."""

    input: str
    motions: int
    followed: int
    frame: float
    p50: float
    p99: float


class CommandTimes:
    """A listener that keeps when each command of the left arm was made, by the clock on the wall."""

    def __init__(self, joints: Array) -> None:
        self._joints = joints
        self.times: list[float] = []
        self.commands: list[Array] = []

    def __call__(self, tick: Tick) -> None:
        self.times.append(time.time())
        self.commands.append(tick.command.q[self._joints])

    def delays(self, moved: list[float]) -> Array:
        """From each motion to the first command that differs from that of the time of the motion [s]."""
        times, commands = np.array(self.times), np.array(self.commands)
        found = []
        for began in moved:
            first, last = np.searchsorted(times, [began, began + _LATEST])
            apart = np.abs(commands[first:last] - commands[first]).max(axis=1) > _MOVED
            if apart.any():
                found.append(times[first + int(apart.argmax())] - began)
        return np.array(found)


def main(
    jumps: Annotated[int, Option(min=10, help="How often the controller moves.")] = 100,
    emulator: Annotated[Path, Option(help="iwer, as make test-web fetches it.")] = Path(
        ".venv/iwer/package/build/iwer.min.js"
    ),
    json: Json = False,
) -> None:
    """Measure from a controller's motion in a browser to the joints' command."""
    from playwright.sync_api import sync_playwright  # which only this needs

    config = WebXrInput.cell(load_config(DEMO_CONFIG))
    # A browser that draws by the processor may be late for longer than an arm waits; it is measured all the same.
    gate = config.teleop.gate.model_copy(update={"timeout": _LATEST})
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
            time.sleep(_LATEST)
        finally:
            pipeline.stop()
            thread.join()
            browser.close()
    delays = 1e3 * commands.delays(result["moved"])
    if not len(delays):
        sys.exit("no motion reached the arm: was it engaged?")
    p50, p99 = np.percentile(delays, [50, 99]).tolist()
    report = PageLatency("webxr", jumps, len(delays), 1e3 * result["frame"], p50, p99)
    print_report(asdict(report), (record_table("hand to joint command, by a page in Chromium", [report]),), json)


if __name__ == "__main__":
    run(main)
