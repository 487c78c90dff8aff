"""Decide who may open a page of this package: browsers on this machine, or browsers that know the token of its URL."""

from __future__ import annotations

import http
import re
import secrets
import ssl
from collections.abc import Sequence
from urllib.parse import parse_qs, urlsplit

from websockets import Headers
from websockets.http11 import Request, Response

from q2r2_control.errors import ConfigError
from q2r2_control.inputs.addresses import reachable_addresses
from q2r2_control.inputs.listener import is_loopback, listening_socket, written

_LOOPBACK = ("localhost", "127.0.0.1", "[::1]")
_PORT = re.compile(r":\d{1,5}$")


def text_response(status: http.HTTPStatus, text: str, kind: str = "text/plain") -> Response:
    body = text.encode()
    headers = Headers({"Content-Type": f"{kind}; charset=utf-8", "Content-Length": str(len(body))})
    # No other page may embed this page. Such a page could deceive the user into clicking this page's buttons.
    headers["X-Frame-Options"] = "DENY"
    return Response(status.value, status.phrase, headers, body)


def protect(response: Response, policy: str) -> None:
    """Add the headers of a page: its content security ``policy``, no caching, and no referrer for other sites."""
    response.headers["Content-Security-Policy"] = policy
    response.headers["Cache-Control"] = "no-store"
    # No other site gets the page's URL, because it contains the token.
    response.headers["Referrer-Policy"] = "no-referrer"


def tls_context(certificate: str | None) -> ssl.SSLContext | None:
    """Return the TLS settings for a certificate, a PEM file with its private key; None without a file.

    Raises:
        ConfigError: If the file cannot be used.
    """
    if certificate is None:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(certificate)
    except (OSError, ssl.SSLError) as error:
        allowed = "allowed: a PEM file with the certificate and its private key"
        raise ConfigError(f"--certificate {certificate}: {error}; {allowed}") from error
    return context


class PageDoor:
    """A listening socket for a page, and the check of every request to the socket.

    A page of another site may not connect, since its ``Origin`` differs. An attacker may also let his own DNS name
    point to this machine. If the socket listens on a loopback address, such a name in ``Host`` is refused, since only
    known names are allowed. The port in ``Host`` is not checked, because ssh may forward another port, and the name is
    enough to refuse an attacker's page. If the socket listens on any other address, a request needs the URL's token.
    """

    def __init__(
        self,
        host: str,
        port: int,
        option: str,
        token: str,
        certificate: str | None = None,
        addresses: Sequence[str] = (),
    ) -> None:
        """Listen on ``host`` and ``port``.

        Args:
            host: The address to listen on.
            port: The port to listen on; 0 for any free port.
            option: The option that error messages name.
            token: The token that a request needs, unless the host is a loopback address.
            certificate: A PEM file with a certificate and its key, to serve the page by HTTPS; None for HTTP.
            addresses: The addresses for the URLs; if empty, the addresses at which ``host`` can be reached.

        Raises:
            ConfigError: If the address cannot be bound, or if the certificate cannot be used.
        """
        self.tls = tls_context(certificate)
        self.socket = listening_socket(host, port, option)
        self.port: int = self.socket.getsockname()[1]
        self._scheme = "http" if certificate is None else "https"
        self._names = {*_LOOPBACK, host.lower()}
        self.token = None if is_loopback(host) else token
        names = tuple(addresses) or reachable_addresses(host)
        self.urls = tuple(f"{self._scheme}://{written(name, self.port)}{self._query}" for name in names)

    def refusal(self, request: Request, *, with_token: bool = True) -> str | None:
        """Return why a request is refused; None if it is allowed."""
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        if len(hosts) != 1:
            return "a request needs one Host"
        if self.token is None and _PORT.sub("", hosts[0].lower()) not in self._names:
            names = ", ".join(sorted(self._names))
            forwarded = f"such as localhost:9000 after ssh -L 9000:localhost:{self.port}"
            return f"unknown Host {hosts[0]!r:.60}; allowed: {names}, at any port, {forwarded}"
        is_socket = request.headers.get("Upgrade") is not None
        if is_socket and [origin.lower() for origin in origins] != [f"{self._scheme}://{hosts[0].lower()}"]:
            return "unknown Origin; allowed: this page's own"
        if self.token is None or not with_token or self._is_known(request):
            return None
        return "the token of the URL is missing"

    @property
    def _query(self) -> str:
        """The part of a URL that contains the token; empty if there is no token."""
        return "" if self.token is None else f"/?token={self.token}"

    def _is_known(self, request: Request) -> bool:
        tokens = parse_qs(urlsplit(request.path).query).get("token", ())
        return any(secrets.compare_digest(token.encode(), str(self.token).encode()) for token in tokens)
