"""A process of a run that serves a page, and Chromium, which opens the page."""

from __future__ import annotations

import io
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from playwright.sync_api import Page

from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array
from q2r2_control.viewer.web.scene import FIELD_OF_VIEW, first_view
from tests.support.processes import cell

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
ARGUMENTS = [
    *("--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run"),
]
# This style hides the warning that drawing is slow, because the warning covers an arm.
HIDDEN = "[class*=mantine-Notification] {display: none !important}"
VIEW = {"width": 680, "height": 360}
PATIENCE = 600.0  # Timeout [s]. A page needs far less, even if a processor draws it beside ten other programs.


_URL = r"(?:page:|webxr: open) (http\S+)\n"


class WebRun:
    """The process of a run with its page, which :mod:`tests.web.slow_run` or another command starts."""

    def __init__(self, errors: Path, *command: str) -> None:
        self._errors = errors
        with open(errors, "w") as file:
            self._process = subprocess.Popen(
                [sys.executable, "-m", *command],
                stdout=subprocess.PIPE,
                stderr=file,
                text=True,
                # If these tests are a background job of a shell, they ignore Ctrl-C, and the run would inherit this.
                preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
            )
        wait_until(lambda: re.search(_URL, self.errors) or self._process.poll() is not None)
        found = re.search(_URL, self.errors)
        assert found is not None, self.errors
        self.url = found[1]

    @property
    def errors(self) -> str:
        return self._errors.read_text()

    def end(self) -> dict[str, Any]:
        """Wait for a run that ends by itself, and return its summary."""
        output, _ = self._process.communicate(timeout=PATIENCE)
        assert self._process.returncode == 0, self.errors
        summary: dict[str, Any] = json.loads(output)
        return summary

    def interrupt(self) -> None:
        """End the run like Ctrl-C."""
        self._process.send_signal(signal.SIGINT)

    def kill(self) -> None:
        """End a run that still runs after a failed test. Otherwise it would occupy a processor during the next test."""
        self._process.kill()
        self._process.communicate()


@contextmanager
def one_processor() -> Iterator[None]:
    """Let browsers that start in the ``with`` block use only one processor.

    They draw by software, and would otherwise use all processors. Processes that start afterwards may use all of them.
    """
    processors = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(processors)})
    yield
    os.sched_setaffinity(0, processors)


def table(page: Page) -> dict[str, list[str]]:
    """Return the rows of the panel's table by name, each with the cells of the left and of the right arm."""
    rows = page.locator("table tr").evaluate_all("rows => rows.map(row => [...row.cells].map(cell => cell.innerText))")
    return {row[0]: row[1:] for row in rows}


def wait_until(condition: Callable[[], object]) -> None:
    """Wait until ``condition`` of a page holds."""
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.1)


def wait_for_row(page: Page, name: str, arm: int, text: str) -> None:
    """Wait until a row of the table has ``text`` for an arm. Otherwise, the failure contains the table."""
    seen: dict[str, list[str]] = {}

    def says() -> bool:
        nonlocal seen
        seen = table(page)
        return text in seen.get(name, ["", ""])[arm]

    try:
        wait_until(says)
    except AssertionError as error:
        raise AssertionError(f"no {text!r} in {name!r} of {seen}") from error


def wait_for(page: Page, text: str) -> None:
    page.get_by_text(text).first.wait_for(timeout=1e3 * PATIENCE)


def tool(page: Page, arm: int = 0) -> Array:
    """Return the position (3,) of a tool that the panel shows [m]."""
    return np.array([float(number) for number in table(page)["tool [m]"][arm].split()])


def pixels(page: Page) -> Array:
    """Return the pixels (height, width, 3) of the scene."""
    picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    box = page.locator("canvas").first.bounding_box()
    assert box is not None
    left, top = box["x"], box["y"]
    return np.asarray(picture.crop((left, top, left + box["width"], top + box["height"])), dtype=float)


def on_screen(page: Page, point: Array) -> tuple[float, float]:
    """Return the pixel of the page at which the first view shows a point (3,) of the world [m]."""
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


def count(picture: Array, colour: tuple[float, float, float]) -> int:
    """Count pixels of about this colour."""
    return int((np.abs(picture - colour).max(axis=2) < 70.0).sum())


_TOUCHED = (255.0, 255.0, 64.0)  # Colour of a gizmo under the mouse.
# Points on a tool's z axis: where the mouse grabs the arrow, and to which it pulls the arrow [m].
_HANDLE, _PULLED = 0.13, 0.07


def grab(page: Page, arm: str, at: Array | None = None) -> None:
    """Press the mouse button on the arrow of a tool, and pull the arrow; see :func:`on_arrow`."""

    def lights_up() -> bool:
        page.mouse.move(*on_arrow(page, arm, _HANDLE, at))
        return count(pixels(page), _TOUCHED) > 0

    wait_until(lights_up)
    page.mouse.down()
    drag(page, arm, _PULLED, at)


def drag(page: Page, arm: str, to: float, at: Array | None = None) -> None:
    """Move the mouse to the point ``to`` [m] on the arrow of a tool; see :func:`on_arrow`."""
    page.mouse.move(*on_arrow(page, arm, to, at), steps=6)


def on_arrow(page: Page, arm: str, along: float, at: Array | None = None) -> tuple[float, float]:
    """Return the pixel of a point on the arrow of a tool. The point is at ``along`` [m] on the tool's z axis.

    The tool has the rotation that it has at home. Its position is ``at`` (3,) [m], by default its position at home.
    """
    robot = Robot.from_config(cell())
    pose = robot.tool_pose(robot.home, arm)
    return on_screen(page, (pose.translation if at is None else at) + pose.rotation @ np.array([0.0, 0.0, along]))
