"""The report page of the judge needs no other files, accepts any name of a recording, and can show any episode."""

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
from q2r2_control.judging.judge import Judged, verdict_of
from q2r2_control.judging.page import COLUMNS, page_of, thinned
from tests.judging.episodes import episode, frame_times
from tests.judging.test_figures import wander


def judged(of: Episode) -> Judged:
    settings = JudgeSettings()
    figures = figures_of(of, settings.dropout)
    return Judged(figures, verdict_of(figures, settings), of, settings)


def moving() -> Judged:
    stamps = np.arange(0.0, 4.0, 1.0 / 75.0)
    return judged(episode(path=wander(frame_times() - 0.05), received=stamps, hand_path=wander(stamps)))


class Page(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]

    @property
    def pictures(self) -> list[str]:
        heads, data = zip(*(str(image["src"]).split(",") for image in self.all("img")), strict=True)
        assert set(heads) == {"data:image/svg+xml;base64"}
        return [b64decode(packed).decode() for packed in data]


@pytest.mark.slow
def test_the_report_page_loads_no_other_files_and_has_a_row_and_a_section_for_each_episode() -> None:
    text = page_of([moving(), judged(episode())], "<script>alert(1)</script> & {braces}")
    page = Page(text)
    assert not page.all("link")
    assert not page.all("script")
    assert "&lt;script&gt;alert(1)&lt;/script&gt; &amp; {braces}" in text
    assert "to &lt;move&gt;" in text
    for picture in page.pictures:
        assert set(re.findall(r'href="([^"]*)"', picture)) <= set(re.findall(r'href="(#[^"]*)"', picture))
        assert "url(http" not in picture
    assert "http" not in re.sub(r"base64,[^\"]*", "", text)
    # The badges are in the table and below it.
    assert [badge["class"] for badge in page.all("b")] == 2 * ["keep", "discard"]
    assert [section["id"] for section in page.all("section")] == ["episode-1", "episode-2"]
    assert [link["href"] for link in page.all("a")] == ["#episode-1", "#episode-2"]
    assert len(page.all("td")) == 2 * (1 + len(COLUMNS))


@pytest.mark.slow
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
def test_any_episode_can_be_judged_and_plotted(of: Episode) -> None:
    found = judged(of)
    assert not found.verdict.keep
    (picture,) = Page(page_of([found], "recordings")).pictures
    ElementTree.fromstring(picture)


def test_a_thinned_curve_keeps_its_largest_and_its_smallest_value() -> None:
    t = np.linspace(0.0, 1.0, 12_345)
    values = np.zeros(len(t))
    values[777], values[9_999], values[5_000:5_100] = 5.0, -3.0, np.nan
    for extreme, value in ((np.fmax, 5.0), (np.fmin, -3.0)):
        few, thin = thinned(t, values, extreme)
        assert len(few) == len(thin) <= 500
        assert extreme.reduce(thin) == value
