"""Tables of the pages in docs/."""

from __future__ import annotations

from pathlib import Path

_DOCS = Path(__file__).resolve().parents[2] / "docs"


def table_rows(page: str) -> list[list[str]]:
    """Return the cells of all rows of all tables of a page."""
    lines = (_DOCS / page).read_text(encoding="utf-8").splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
