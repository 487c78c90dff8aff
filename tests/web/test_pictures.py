"""The page of a run shows the pictures of the cell's cameras."""

from __future__ import annotations

import io

from PIL import Image

from tests.support.page_client import PageClient
from tests.support.processes import CELL
from tests.web.conftest import Start


def test_the_page_of_a_simulated_cell_shows_the_pictures_of_its_cameras(start: Start) -> None:
    run = start("q2r2_control", "run", CELL, "--plant", "mujoco", "--headless", "--json", "--web", "--web-port", "0")
    with PageClient(run.url) as page:
        page.wait_until(lambda: len(set(page.pictures)) > 1)  # The pictures differ, because the arms move.
        picture = Image.open(io.BytesIO(page.pictures[-1]))
        assert picture.size == (320, 240)
        assert len(picture.getcolors(320 * 240) or ()) > 50
    run.interrupt()
    assert run.end()["at_rest"]
