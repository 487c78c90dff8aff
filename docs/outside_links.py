"""A hook of mkdocs that replaces each link to a file outside of docs/ by its text, because the site has no such page.

tests/test_project.py checks these links. mkdocs itself checks all others, and fails if one leads nowhere.
"""

from __future__ import annotations

import re
from typing import Any

OUTSIDE = re.compile(r"\[([^\]]*)\]\(\.\./[^)]*\)")


def on_page_markdown(markdown: str, **_: Any) -> str:
    return OUTSIDE.sub(r"\1", markdown)
