"""The check of all requests to the page that viser serves."""

from __future__ import annotations

import http
import secrets
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from q2r2_control.errors import ConfigError
from q2r2_control.inputs.page_door import PageDoor, protect, text_response
from q2r2_control.viewer.web.browser_messages import LONGEST_MESSAGE, BrowserMessages, FilteredConnection
from q2r2_control.viewer.web.page_file import PageFile

_MOST_CLIENTS = 12  # Greatest number of pages that may be open at one time.
# The content security policy allows what viser's page needs. The page is one file with its scripts and styles, compiles
# WebAssembly, and starts workers from blobs. Its sorter of Gaussian splats evaluates text as code. The policy forbids
# this, because this page shows no splats.
_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:; style-src 'self' 'unsafe-inline'; "
    "connect-src 'self' blob: data:; img-src 'self' blob: data:; font-src 'self' data:; worker-src 'self' blob: data:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'; object-src 'none'"
)
_CLOSE_TIMEOUT = 1.0  # Longest time until a browser confirms that a connection is closed [s].


class Door(PageDoor):
    """Checks the requests to viser's page. The page connects to the path of its URL, so the token is this path."""

    def __init__(self, host: str, port: int, certificate: str | None = None, addresses: Sequence[str] = ()) -> None:
        """Open the socket. The arguments are the same as for :class:`PageDoor`."""
        super().__init__(host, port, "--web", secrets.token_urlsafe(16), certificate, addresses)
        self.messages = BrowserMessages()  # Decides which messages viser gets.
        self._clients = 0

    def refusal(self, request: Request, *, with_token: bool = True) -> str | None:
        reason = super().refusal(request, with_token=with_token)
        if reason is None and request.headers.get("Upgrade") is not None and self._clients >= _MOST_CLIENTS:
            return f"{_MOST_CLIENTS} pages are open"
        return reason

    @property
    def _query(self) -> str:
        return "" if self.token is None else f"/{self.token}"

    def _is_known(self, request: Request) -> bool:
        path, _, _ = request.path.partition("?")
        return secrets.compare_digest(path.strip("/").encode(), str(self.token).encode())

    @contextmanager
    def guards(self, name: str) -> Iterator[None]:
        """Check all requests to the servers that the package websockets starts in this context, such as viser's server.

        The title of the served page becomes ``name``, the name of a cell.

        Raises:
            ConfigError: If no server was started, because then nothing would check requests.
        """
        serve, used, page = websockets.asyncio.server.serve, False, PageFile(name)

        def guarded(handler: Callable[[ServerConnection], Awaitable[None]], *_: Any, **settings: Any) -> Any:
            nonlocal used
            used = True
            answer = settings.pop("process_request")

            def checked(connection: ServerConnection, request: Request) -> Response | None:
                if (reason := self.refusal(request)) is not None:
                    return text_response(http.HTTPStatus.FORBIDDEN, f"{reason}\n")
                request.path = "/"  # Every path leads to the page, because viser serves nothing else.
                response: Response | None = answer(connection, request)
                if response is not None:
                    page.change(response)
                    protect(response, _POLICY)
                    # No other page may embed this page. A user could then be tricked into clicking its buttons.
                    response.headers["X-Frame-Options"] = "DENY"
                return response

            async def counted(connection: ServerConnection) -> None:
                self._clients += 1
                try:
                    await handler(connection)
                finally:
                    self._clients -= 1

            settings |= {"max_size": LONGEST_MESSAGE, "sock": self.socket, "ssl": self.tls}
            settings |= {"close_timeout": _CLOSE_TIMEOUT}
            settings["create_connection"] = partial(FilteredConnection, messages=self.messages)
            return serve(counted, process_request=checked, **settings)

        setattr(websockets.asyncio.server, "serve", guarded)  # noqa: B010 (a type checker refuses the assignment)
        try:
            yield
        finally:
            setattr(websockets.asyncio.server, "serve", serve)  # noqa: B010
        if not used:
            raise ConfigError("--web: this version of viser cannot be guarded; allowed: one that pyproject.toml names")
