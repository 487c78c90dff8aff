from __future__ import annotations

import pytest

from q2r2_control.errors import PlantError
from q2r2_control.plants.mujoco import MujocoPlant


def test_a_window_without_a_display_is_refused_with_the_reason(
    plant: MujocoPlant, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.raises(PlantError, match="needs a display"):
        plant.launch_viewer()
    assert plant.viewer_sync() is False


@pytest.mark.parametrize(("width", "height"), [(0, 480), (640, -1), (100_000, 480)])
def test_a_picture_of_an_impossible_size_is_refused_with_what_is_allowed(
    plant: MujocoPlant, width: int, height: int
) -> None:
    with pytest.raises(PlantError, match=r"allowed: 1 x 1 .. 3840 x 2160"):
        plant.render(width, height)
