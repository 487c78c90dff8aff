"""The page needs nothing but itself, whatever recordings are called, and does not grow with their length."""

from __future__ import annotations

import re
from base64 import b64decode
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest

from q2r2_control.config.recording import JudgeSettings
from q2r2_control.judging.episode import Episode
from q2r2_control.judging.figures import figures_of
from q2r2_control.judging.judge import Judged
from q2r2_control.judging.page import COLUMNS, page_of
from q2r2_control.judging.plots import thinned
from q2r2_control.judging.verdict import verdict_of
from tests.judging.episodes import episode, frame_times
from tests.judging.test_figures import wander


def judged(of: Episode) -> Judged:
    settings = JudgeSettings()
    figures = figures_of(of, settings.dropout)
    return Judged(of, figures, verdict_of(figures, settings), settings)


def moving(seconds: float = 4.0) -> Judged:
    stamps = np.arange(0.0, seconds, 1.0 / 75.0)
    later = wander(frame_times(seconds) - 0.05)
    return judged(episode(seconds, path=later, received=stamps, hand_path=wander(stamps)))


class Page(HTMLParser):
    """What a page has: its elements, with their attributes, and the text of cells."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]


def test_nothing_is_fetched_from_elsewhere() -> None:
    text = page_of([moving(), judged(episode())], "recordings")
    page = Page(text)
    assert not page.all("link")
    assert not page.all("script")
    assert all(str(image["src"]).startswith("data:image/svg+xml;base64,") for image in page.all("img"))
    for image in page.all("img"):
        picture = b64decode(str(image["src"]).partition(",")[2]).decode()
        assert set(re.findall(r'href="([^"]*)"', picture)) <= set(re.findall(r'href="(#[^"]*)"', picture))
        assert "url(http" not in picture
    outside = re.sub(r"base64,[^\"]*", "", text)
    assert "http" not in outside


def test_each_episode_has_a_row_with_its_verdict_and_a_section() -> None:
    page = Page(page_of([moving(), judged(episode())], "recordings"))
    assert [badge["class"] for badge in page.all("b")] == 2 * ["keep", "discard"]  # in the table, and below
    assert [section["id"] for section in page.all("section")] == ["episode-1", "episode-2"]
    assert [link["href"] for link in page.all("a")] == ["#episode-1", "#episode-2"]
    assert len(page.all("td")) == 2 * (1 + len(COLUMNS))


def test_names_and_tasks_are_text_whatever_is_in_them() -> None:
    text = page_of([moving()], "<script>alert(1)</script> & {braces}")
    assert "<script>alert" not in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt; &amp; {braces}" in text
    assert "to &lt;stack&gt;" in text


@pytest.mark.parametrize(
    "of",
    [
        pytest.param(episode(0.0), id="no tick"),
        pytest.param(episode(0.002), id="one tick"),
        pytest.param(episode(engaged=np.zeros(2000, dtype=bool)), id="never engaged"),
        pytest.param(episode(received=()), id="no pose"),
        pytest.param(episode(margin=np.full(2000, np.inf), certified=np.zeros(2000, dtype=bool)), id="no pairs"),
        pytest.param(episode(path=np.full((400, 3), np.nan)), id="tools that are no numbers"),
    ],
)
def test_any_episode_can_be_judged_and_drawn(of: Episode) -> None:
    found = judged(of)
    assert not found.verdict.keep
    (picture,) = Page(page_of([found], "recordings")).all("img")
    ElementTree.fromstring(b64decode(str(picture["src"]).partition(",")[2]))


def test_thinning_keeps_the_extremes() -> None:
    t = np.linspace(0.0, 1.0, 12_345)
    values = np.zeros(len(t))
    values[777], values[9_999], values[5_000:5_100] = 5.0, -3.0, np.nan
    for extreme, value in ((np.fmax, 5.0), (np.fmin, -3.0)):
        few, thin = thinned(t, values, extreme)
        assert len(few) == len(thin) <= 500
        assert extreme.reduce(thin) == value
