"""The file of viser's page, with the name of the cell and a layout for the screen of a phone."""

from __future__ import annotations

import gzip
from html import escape

from websockets.http11 import Response

_TITLE = b"<title>Viser</title>"
# On a phone, viser's panel covers the scene. This style gives the panel the lower half of the screen, and the scene the
# upper half.
_SHEET = '.mantine-Paper-root[style*="position: fixed"][style*="bottom: 0"]'
_PHONE = (
    f"<style>@media (max-width: 576px) {{{_SHEET} {{width: 100% !important; max-height: 50vh !important}} "
    f"{_SHEET} .mantine-ScrollArea-content > div {{width: 100% !important}} "
    'div[style*="flex-grow: 1; height: 100%"]:has(canvas) '
    "{height: 50vh !important; flex: none !important; width: 100vw !important}}</style>"
)
# This style moves viser's notices to the lower edge, because they would hide the arms at the upper edge. An example is
# the notice that the browser draws without a graphics card. On a phone, only the titles of the notices are shown,
# because their texts would cover the whole picture.
_NOTICES = (
    "<style>.mantine-Notifications-root {top: auto !important; bottom: 1em !important} "
    "@media (max-width: 576px) {.mantine-Notifications-root {bottom: calc(50vh + 0.5em) !important} "
    ".mantine-Notification-description {display: none}}</style>"
)


class PageFile:
    """Changes viser's page for one cell."""

    def __init__(self, name: str) -> None:
        self._head = f"<title>{escape(name)}</title>{_PHONE}{_NOTICES}".encode()
        self._made: dict[bytes, bytes] = {}  # For each page of viser, the page that replaces it.

    def change(self, response: Response) -> None:
        """Replace viser's page in ``response`` by the changed page. Responses that report an error stay as they are."""
        if response.status_code != 200:
            return
        is_compressed = response.headers.get("Content-Encoding") == "gzip"
        body = bytes(response.body)
        if body not in self._made:
            plain = gzip.decompress(body) if is_compressed else body
            plain = plain.replace(_TITLE, self._head, 1)
            self._made[body] = gzip.compress(plain) if is_compressed else plain
        response.body = self._made[body]
        del response.headers["Content-Length"]
        response.headers["Content-Length"] = str(len(response.body))
