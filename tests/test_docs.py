"""The documentation is current: its reference is that of the settings, and every file that it links to exists."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.support.modules import ROOT, load_script

PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *ROOT.glob("q2r2_control/**/*.md")])


def test_the_configuration_reference_is_made_from_the_settings_of_now() -> None:
    made = load_script("docs/make_reference.py")
    assert made.FILE.read_text(encoding="utf-8") == made.reference(), "python docs/make_reference.py"


@pytest.mark.parametrize("page", PAGES, ids=[str(page.relative_to(ROOT)) for page in PAGES])
def test_every_file_that_a_page_links_to_exists(page: Path) -> None:
    for link in re.findall(r"\]\((?!https?:|#|mailto:)([^)#\s]+)", page.read_text(encoding="utf-8")):
        assert (page.parent / link).exists(), link
