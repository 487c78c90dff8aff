"""A run with its page, in a process of its own, and Chromium that looks at it."""

from __future__ import annotations

import io
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from PIL import Image
from playwright.sync_api import Page

from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array
from q2r2_control.viewer.web.scene import FIELD_OF_VIEW, first_view
from tests.support.processes import CELL, cell

CHROMIUM = "/usr/bin/chromium"
ARGUMENTS = [
    *("--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run"),
]
VIEW = {"width": 720, "height": 400}
_PATIENCE = 40.0  # with a page drawn by the processor [s]
# A processor that is busy drawing stops no arm.
_PATIENT = (("    timeout: 0.15 ", "    timeout: 2.0 "), ("loop_rate_hz: 1000.0 ", "loop_rate_hz: 500.0 "))


class WebRun:
    """``q2r2 run`` with its page, driven by it."""

    def __init__(self, folder: Path, *options: str, port: int = 0) -> None:
        file = folder / "cell.yaml"
        text = Path(CELL).read_text(encoding="utf-8")
        for usual, patient in _PATIENT:
            assert usual in text
            text = text.replace(usual, patient)
        file.write_text(text, encoding="utf-8")
        self._errors = folder / "stderr"
        command = [sys.executable, "-m", "q2r2_control", "run", str(file), "--plant", "kinematic", "--headless"]
        command += ["--json", "--web", "--web-port", str(port), *options]
        with open(self._errors, "w") as errors:
            self._process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True)
        wait_until(lambda: "page: " in self.errors or self._process.poll() is not None)
        found = re.search(r"page: (\S+)", self.errors)
        assert found is not None, self.errors
        self.url = found[1]

    @property
    def errors(self) -> str:
        return self._errors.read_text()

    def end(self) -> dict[str, Any]:
        """The summary of a run that ends by itself."""
        output, _ = self._process.communicate(timeout=_PATIENCE)
        assert self._process.returncode == 0, self.errors
        summary: dict[str, Any] = json.loads(output)
        return summary

    def interrupt(self) -> None:
        """As Ctrl-C does."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)


def leave_a_processor_to_the_loop() -> None:
    """Browsers draw by the processor here, and take all that there are."""
    if len(processors := sorted(os.sched_getaffinity(0))) > 1:
        os.sched_setaffinity(0, processors[1:])


def table(page: Page) -> dict[str, list[str]]:
    """Rows of the panel's table: what is said of the left and of the right arm."""
    rows = page.locator("table tr").evaluate_all("rows => rows.map(row => [...row.cells].map(cell => cell.innerText))")
    return {row[0]: row[1:] for row in rows}


def wait_until(condition: Callable[[], object]) -> None:
    """Wait until ``condition`` of a page holds; the last value is in the failure."""
    deadline = time.monotonic() + _PATIENCE
    while not (found := condition()):
        assert time.monotonic() < deadline, f"waited in vain: {found}"
        time.sleep(0.1)


def wait_for(page: Page, text: str) -> None:
    page.get_by_text(text).first.wait_for(timeout=1e3 * _PATIENCE)


def tool(page: Page, arm: int = 0) -> Array:
    """Position (3,) of a tool, as the panel says [m]."""
    return np.array([float(number) for number in table(page)["tool [m]"][arm].split()])


def pixels(page: Page) -> Array:
    """(height, width, 3) of the scene."""
    picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    box = page.locator("canvas").first.bounding_box()
    assert box is not None
    left, top = box["x"], box["y"]
    return np.asarray(picture.crop((left, top, left + box["width"], top + box["height"])), dtype=float)


def on_screen(page: Page, point: Array) -> tuple[float, float]:
    """Where the first view shows a point (3,) of the world [m], in the page's pixels."""
    robot = Robot.from_config(cell())
    eye, middle = first_view(robot.model, robot.home)
    forward = (middle - eye) / np.linalg.norm(middle - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    x, y, depth = (float(axis @ (point - eye)) for axis in (right, np.cross(right, forward), forward))
    box = page.locator("canvas").first.bounding_box()
    assert box is not None
    scale = box["height"] / 2.0 / math.tan(FIELD_OF_VIEW / 2.0) / depth
    return box["x"] + box["width"] / 2.0 + scale * x, box["y"] + box["height"] / 2.0 - scale * y


def tool_at_home(arm: str) -> pin.SE3:
    robot = Robot.from_config(cell())
    return robot.tool_pose(robot.home, arm)
