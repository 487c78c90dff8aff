"""Who may open the page: browsers of this machine, or those that know the token."""

from __future__ import annotations

import http
import ipaddress
import secrets
import socket
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

import websockets.asyncio.server
from websockets import Headers
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from q2r2_control.errors import ConfigError

_COOKIE = "q2r2_page"
_MOST_CLIENTS = 8
_LONGEST_MESSAGE = 1 << 20  # from a browser [bytes]


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class Door:
    """A socket that listens, and the check of every request to it.

    A page of another site may not connect, since its ``Origin`` differs; nor may a name that an attacker's DNS leads
    here, since the ``Host`` of a loopback address is known. Beyond loopback, a request needs the token of the URL; the
    page gets it back as a cookie, with which its own connection comes.
    """

    def __init__(self, host: str, port: int) -> None:
        """Raises :class:`ConfigError` where the address cannot be bound."""
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            self.socket = socket.create_server((host, port), family=family)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise ConfigError(f"--web: cannot listen on {host} port {port}: {reason}; allowed: a free port") from error
        self.port: int = self.socket.getsockname()[1]
        self._hosts = {f"{name}:{self.port}" for name in ("localhost", "127.0.0.1", "[::1]", host)}
        self._token = None if is_loopback(host) else secrets.token_urlsafe(16)
        wildcard = host in ("0.0.0.0", "::")
        name = socket.gethostname() if wildcard else f"[{host}]" if ":" in host else host
        query = "" if self._token is None else f"/?token={self._token}"
        self.url = f"http://{name}:{self.port}{query}"
        self._clients = 0

    def refusal(self, request: Request) -> str | None:
        """Why a request is not answered, or None."""
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        if len(hosts) != 1 or (self._token is None and hosts[0].lower() not in self._hosts):
            return "unknown Host"
        if request.headers.get("Upgrade") is not None:
            if [origin.lower() for origin in origins] != [f"http://{hosts[0].lower()}"]:
                return "unknown Origin"
            if self._clients >= _MOST_CLIENTS:
                return f"{_MOST_CLIENTS} pages are open"
        if self._token is None or self._token in parse_qs(urlsplit(request.path).query).get("token", ()):
            return None
        try:
            morsel = SimpleCookie(request.headers.get("Cookie", "")).get(_COOKIE)
        except CookieError:
            morsel = None
        known = morsel is not None and secrets.compare_digest(morsel.value.encode(), self._token.encode())
        return None if known else "the token of the URL is missing"

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
                    body = f"{reason}\n".encode()
                    headers = Headers({"Content-Type": "text/plain", "Content-Length": str(len(body))})
                    return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", headers, body)
                response: Response | None = answer(connection, request)
                if response is not None:
                    response.headers["X-Frame-Options"] = "DENY"  # a page around this one could steal a click
                    if self._token is not None:
                        response.headers["Set-Cookie"] = f"{_COOKIE}={self._token}; HttpOnly; SameSite=Strict; Path=/"
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
