"""Draw docs/demo.webp, the README's moving picture. It shows three tasks of the demo as MuJoCo simulates them."""

from __future__ import annotations

from pathlib import Path

import mujoco
from PIL import Image

from q2r2_control import Pipeline, load_config
from q2r2_control.inputs.scripted import ScriptedInput, trajectory_named
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.summary.tick import Tick

ROOT = Path(__file__).resolve().parents[1]
TASKS = "handover+stack+peg"
WIDTH, HEIGHT = 960, 540
# Speed of the playback as a multiple of real time, and pictures per second [Hz].
PLAYBACK_SPEED, PICTURE_RATE_HZ = 4.0, 10.0


def camera() -> mujoco.MjvCamera:
    view = mujoco.MjvCamera()
    view.lookat, view.distance, view.azimuth, view.elevation = (0.5, 0.0, 0.44), 1.0, 165.0, -22.0
    return view


def main() -> None:
    pipeline = Pipeline.from_config(
        load_config(ROOT / "config" / "dual_iiwa7.yaml"), input=ScriptedInput(TASKS), plant="mujoco", mode="torque"
    )
    plant = pipeline.plant
    assert isinstance(plant, MujocoPlant)
    plant.model.vis.quality.shadowsize = 2048  # The default of 8192 takes long without a graphics card.
    renderer, view = mujoco.Renderer(plant.model, HEIGHT, WIDTH), camera()
    pictures: list[Image.Image] = []

    def draw(tick: Tick) -> None:
        if tick.t * PICTURE_RATE_HZ / PLAYBACK_SPEED >= len(pictures):
            renderer.update_scene(plant.data, view)
            pictures.append(Image.fromarray(renderer.render()))

    pipeline.listeners.append(draw)
    pipeline.run(trajectory_named(TASKS).duration, realtime=False)
    first, *rest = pictures
    file = ROOT / "docs" / "demo.webp"
    first.save(
        file, save_all=True, append_images=rest, duration=round(1e3 / PICTURE_RATE_HZ), loop=0, quality=60, method=4
    )
    print(f"{file}: {len(pictures)} pictures, {file.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
