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
