"""Hook of mkdocs: a link to a file outside of docs/ becomes its text, since the site has no such page.

tests/test_project.py checks these links. All others are left to mkdocs, which fails on one that leads nowhere.
"""

from __future__ import annotations

import re
from typing import Any

OUTSIDE = re.compile(r"\[([^\]]*)\]\(\.\./[^)]*\)")


def on_page_markdown(markdown: str, **_: Any) -> str:
    return OUTSIDE.sub(r"\1", markdown)
