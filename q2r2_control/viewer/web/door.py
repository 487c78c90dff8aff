"""The door of the page that viser serves."""

from __future__ import annotations

import http
import secrets
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from http.cookies import CookieError, SimpleCookie
from typing import Any

import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from q2r2_control.errors import ConfigError
from q2r2_control.inputs.page_door import PageDoor, text_response

_COOKIE = "q2r2_page"
_MOST_CLIENTS = 12
_LONGEST_MESSAGE = 1 << 20  # from a browser [bytes]


class Door(PageDoor):
    """The page gets the token back as a cookie, with which its own connection comes."""

    def __init__(self, host: str, port: int) -> None:
        """Raises :class:`ConfigError` where the address cannot be bound."""
        super().__init__(host, port, "--web", secrets.token_urlsafe(16))
        self._clients = 0

    def refusal(self, request: Request, *, with_token: bool = True) -> str | None:
        reason = super().refusal(request, with_token=with_token)
        if reason is None and request.headers.get("Upgrade") is not None and self._clients >= _MOST_CLIENTS:
            return f"{_MOST_CLIENTS} pages are open"
        return reason

    def _is_known(self, request: Request) -> bool:
        try:
            morsel = SimpleCookie(request.headers.get("Cookie", "")).get(_COOKIE)
        except CookieError:
            morsel = None
        known = morsel is not None and secrets.compare_digest(morsel.value.encode(), str(self.token).encode())
        return known or super()._is_known(request)

    @contextmanager
    def guards(self) -> Iterator[None]:
        """Servers of ``websockets`` that are started meanwhile, as viser's, listen behind this door.

        Raises :class:`ConfigError` where none was: then nothing would check requests.
        """
        serve, used = websockets.asyncio.server.serve, False

        def guarded(handler: Callable[[ServerConnection], Awaitable[None]], *_: Any, **settings: Any) -> Any:
            nonlocal used
            used = True
            answer = settings.pop("process_request")

            def checked(connection: ServerConnection, request: Request) -> Response | None:
                if (reason := self.refusal(request)) is not None:
                    return text_response(http.HTTPStatus.FORBIDDEN, f"{reason}\n")
                response: Response | None = answer(connection, request)
                if response is not None:
                    response.headers["X-Frame-Options"] = "DENY"  # a page around this one could steal a click
                    if self.token is not None:
                        response.headers["Set-Cookie"] = f"{_COOKIE}={self.token}; HttpOnly; SameSite=Strict; Path=/"
                return response

            async def counted(connection: ServerConnection) -> None:
                self._clients += 1
                try:
                    await handler(connection)
                finally:
                    self._clients -= 1

            settings |= {"max_size": _LONGEST_MESSAGE, "sock": self.socket}
            return serve(counted, process_request=checked, **settings)

        setattr(websockets.asyncio.server, "serve", guarded)  # noqa: B010, which a type checker would refuse
        try:
            yield
        finally:
            setattr(websockets.asyncio.server, "serve", serve)  # noqa: B010
        if not used:
            raise ConfigError("--web: this version of viser cannot be guarded; allowed: one that pyproject.toml names")
