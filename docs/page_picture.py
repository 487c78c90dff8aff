"""Draw docs/page.webp, the page of the demo's hand-over in Chromium: python -m docs.page_picture.

The run stands still while the picture is taken. The picture shows the loop's figures of this machine.
"""

from __future__ import annotations

import io
import time
from pathlib import Path
from threading import Event, Thread

from PIL import Image
from playwright.sync_api import sync_playwright

from q2r2_control import Pipeline, load_config
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.summary.tick import Tick
from q2r2_control.viewer.web.view import PageView
from tests.web.browser import ARGUMENTS, CHROMIUM, HIDDEN, one_processor

FILE = Path(__file__).resolve().parent / "page.webp"
CELL = FILE.parents[1] / "config" / "dual_iiwa7.yaml"
VIEW = {"width": 1280, "height": 760}
PICTURE_TIME_S = 11.4  # Time of the run at which both grippers hold the bar [s].
_SETTLING_S = 4.0  # Time to wait before the run begins, and again before the picture is taken [s].


class Photographer:
    """A listener that runs the loop in real time, and lets a browser open the page and take its picture."""

    def __init__(self) -> None:
        self.url = ""
        self._opened, self._due, self._taken = Event(), Event(), Event()
        self._began = 0.0

    def __call__(self, tick: Tick) -> None:
        if not self._opened.is_set():
            self._opened.wait()
            self._began = time.monotonic() - tick.t
        time.sleep(max(self._began + tick.t - time.monotonic(), 0.0))
        if tick.t >= PICTURE_TIME_S and not self._due.is_set():
            self._due.set()
            self._taken.wait()

    def work(self) -> None:
        with one_processor():
            playwright = sync_playwright().start()
        page = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS).new_page(viewport=VIEW)
        page.set_default_timeout(0)  # A busy computer may draw slowly; Ctrl-C ends the wait.
        page.goto(f"{self.url}?fixedDpr=1")
        page.add_style_tag(content=HIDDEN)
        page.wait_for_timeout(1e3 * _SETTLING_S)
        self._opened.set()
        page.get_by_text("certified").first.wait_for()
        self._due.wait()
        page.wait_for_timeout(1e3 * _SETTLING_S)
        page.screenshot()  # This first picture makes the browser draw the last frame.
        Image.open(io.BytesIO(page.screenshot())).save(FILE, quality=82, method=6)
        playwright.stop()
        self._taken.set()


def main() -> None:
    photographer = Photographer()
    with PageView("127.0.0.1", 0) as view:
        pipeline = Pipeline.from_config(
            load_config(CELL), input=ScriptedInput("handover"), plant="mujoco", mode="torque"
        )
        photographer.url = view.begin(pipeline, "demo", False)
        pipeline.listeners.append(photographer)
        worker = Thread(target=photographer.work)
        worker.start()
        pipeline.run(PICTURE_TIME_S + 0.1, realtime=False)
        worker.join()
    print(f"{FILE}: {FILE.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
