"""Pictures of a cell's cameras come to its page."""

from __future__ import annotations

import io
from pathlib import Path

from PIL import Image

from tests.support.page_client import PageClient
from tests.support.processes import CELL
from tests.web.conftest import Start

CAMERA = "cameras: {front: {position: [1.9, 0.0, 1.0], look_at: [0.4, 0.0, 0.3], width: 64, height: 48}}  "


def test_the_page_of_a_simulated_cell_shows_what_its_camera_sees(start: Start, tmp_path: Path) -> None:
    (cell := tmp_path / "cell.yaml").write_text(Path(CELL).read_text().replace("cameras: {} ", CAMERA))
    run = start(
        "q2r2_control", "run", str(cell), "--plant", "mujoco", "--headless", "--json", "--web", "--web-port", "0"
    )
    with PageClient(run.url) as page:
        page.wait_until(lambda: len(set(page.pictures)) > 1)  # the arms move
        front = Image.open(io.BytesIO(page.pictures[-1]))
        assert front.size == (64, 48)
        assert len(front.getcolors(64 * 48) or ()) > 50
    run.interrupt()
    assert run.end()["at_rest"]
