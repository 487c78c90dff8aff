"""MuJoCo's window beside a run."""

from __future__ import annotations

import time

from q2r2_control.errors import ConfigError
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.summary.tick import Tick

_PERIOD = 1.0 / 30.0  # [s]


def check_window(plant: str | None) -> None:
    """Raises :class:`ConfigError` for a plant without a window."""
    if plant != "mujoco":
        which = "without --plant there is no window" if plant is None else f"the {plant} plant has no window"
        raise ConfigError(f"--viewer: {which}; allowed: --plant mujoco")


def show_window(pipeline: Pipeline, *, paced: bool = False) -> None:
    """Open the window and keep it up to date while ``pipeline`` runs, which closing it ends.

    ``paced``: simulated time passes no faster than that of the clock on the wall. Raises :class:`PlantError` where
    there is no display.
    """
    if isinstance(pipeline.plant, MujocoPlant):
        pipeline.plant.launch_viewer()
        pipeline.listeners.append(_WindowListener(pipeline, pipeline.plant, paced))


class _WindowListener:
    """Shows the window some thirty times a second."""

    def __init__(self, pipeline: Pipeline, plant: MujocoPlant, paced: bool) -> None:
        self._pipeline, self._plant, self._paced = pipeline, plant, paced
        self._due = 0.0
        self._began: float | None = None

    def __call__(self, tick: Tick) -> None:
        if tick.t < self._due:
            return
        self._due = tick.t + _PERIOD
        if self._paced:
            now = time.monotonic()
            self._began = now - tick.t if self._began is None else self._began
            time.sleep(max(self._began + tick.t - now, 0.0))
        if not self._plant.viewer_sync():
            self._pipeline.stop()
