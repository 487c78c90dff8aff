"""Access control: a page of this computer may connect, and a page on another computer needs the token."""

from __future__ import annotations

import gzip
import ssl
from collections.abc import Iterator
from datetime import UTC, datetime
from http.client import HTTPConnection, HTTPSConnection, RemoteDisconnected
from pathlib import Path
from urllib.parse import urlsplit

import pytest
import viser
from websockets import Headers
from websockets.exceptions import InvalidStatus
from websockets.http11 import Request, Response
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from q2r2_control.errors import ConfigError
from q2r2_control.inputs.page_door import is_loopback
from q2r2_control.inputs.webxr.certificate import own_certificate
from q2r2_control.viewer.web.door import Door
from q2r2_control.viewer.web.page import Page
from q2r2_control.viewer.web.page_file import PageFile


@pytest.fixture(scope="module", params=["127.0.0.1", "0.0.0.0"], ids=["loopback", "all addresses"])
def door(request: pytest.FixtureRequest) -> Iterator[Door]:
    made = Door(request.param, 0)
    with made.guards("cell"):
        server = viser.ViserServer(host=request.param, port=made.port, verbose=False)
    yield made
    server.stop()


def status(door: Door, path: str = "/", **headers: str) -> int:
    """Return the HTTP status of the answer to a request."""
    connection = HTTPConnection("127.0.0.1", door.port)
    connection.request("GET", path, headers=headers)
    return connection.getresponse().status


def token_of(door: Door) -> str:
    """Return the token, which is empty on loopback."""
    return urlsplit(door.urls[0]).path.strip("/")


def connected(door: Door, origin: str, token: str) -> ClientConnection:
    """Connect as viser's page does, to the path of the page's URL, which is the token."""
    protocol = [Subprotocol(f"viser-v{viser.__version__}")]
    return connect(f"ws://127.0.0.1:{door.port}/{token}", origin=Origin(origin), subprotocols=protocol)


def admitted(door: Door, origin: str, token: str) -> bool:
    """Return whether a page of ``origin`` may connect."""
    try:
        connected(door, origin, token).close()
    except InvalidStatus as error:
        return error.response.status_code != 403
    return True


def test_only_the_servers_own_page_may_connect(door: Door) -> None:
    own = f"http://127.0.0.1:{door.port}"
    token = token_of(door)
    assert admitted(door, own, token)
    assert not admitted(door, "http://example.org", token)
    assert not admitted(door, "null", token)
    if token:
        assert not admitted(door, own, "")
        assert not admitted(door, own, "guess")
        assert (status(door), status(door, f"/{token}")) == (403, 200)
    else:
        assert status(door) == 200
        # An attacker can let this host name refer to the address of this computer.
        assert status(door, Host=f"example.org:{door.port}") == 403
        assert status(door, Host="example.org:9000") == 403


def test_a_page_through_a_forwarded_port_may_connect_and_the_refusal_of_another_host_says_what_is_allowed(
    door: Door,
) -> None:
    if door.token is not None:
        pytest.skip("beyond loopback the token decides")
    assert status(door, Host="localhost:9000") == 200  # A browser sends this host after ssh -L 9000:localhost:PORT.
    request = Request("/", Headers({"Host": "example.org:9000"}))
    assert door.refusal(request) == (
        "unknown Host 'example.org:9000'; allowed: 127.0.0.1, [::1], localhost, at any port, "
        f"such as localhost:9000 after ssh -L 9000:localhost:{door.port}"
    )
    # A page of another server on this computer is still another site.
    stranger = Headers({"Host": f"localhost:{door.port}", "Origin": "http://localhost:5000", "Upgrade": "websocket"})
    assert str(door.refusal(Request("/", stranger))).startswith("unknown Origin")
    own = Headers({"Host": "localhost:9000", "Origin": "http://localhost:9000", "Upgrade": "websocket"})
    assert door.refusal(Request("/", own)) is None


@pytest.mark.parametrize("encoding", ["gzip", "identity"])
def test_the_tab_of_the_page_has_the_name_of_the_cell(encoding: str) -> None:
    plain = b"<head><title>Viser</title></head>"
    body = gzip.compress(plain) if encoding == "gzip" else plain
    headers = Headers({"Content-Encoding": encoding, "Content-Length": str(len(body))})
    response = Response(200, "OK", headers, body)
    PageFile("<two> arms").change(response)
    changed = gzip.decompress(response.body) if encoding == "gzip" else response.body
    assert b"<title>&lt;two&gt; arms</title>" in changed
    assert b".mantine-Notifications-root {top: auto" in changed  # viser's notices would cover the arms.
    assert response.headers["Content-Length"] == str(len(response.body))


def test_only_a_few_pages_can_be_connected_at_the_same_time(door: Door) -> None:
    origin, token = f"http://127.0.0.1:{door.port}", token_of(door)
    pages = [connected(door, origin, token) for _ in range(12)]
    assert not admitted(door, origin, token)
    for page in pages:
        page.close()


def test_other_computers_get_the_page_only_by_tls_and_may_neither_cache_it_nor_show_it_in_a_frame(
    tmp_path: Path,
) -> None:
    certificate, _ = own_certificate(tmp_path, ["192.168.1.5", "10.0.0.7"], datetime.now(UTC))
    far = Door("0.0.0.0", 0, str(certificate), ["192.168.1.5", "10.0.0.7"])
    token = token_of(far)
    assert far.urls == tuple(f"https://{address}:{far.port}/{token}" for address in ("192.168.1.5", "10.0.0.7"))
    with far.guards("cell"):
        server = viser.ViserServer(host="0.0.0.0", port=far.port, verbose=False)
    trusting = ssl.create_default_context(cafile=str(certificate))
    connection = HTTPSConnection("127.0.0.1", far.port, context=trusting)
    connection.request("GET", f"/{token}")
    response = connection.getresponse()
    assert response.status == 200
    assert response.headers["Cache-Control"] == "no-store"
    assert response.headers["Referrer-Policy"] == "no-referrer"
    policy = response.headers["Content-Security-Policy"]
    assert "default-src 'self'" in policy
    assert "'unsafe-eval'" not in policy
    connection.close()
    with pytest.raises((RemoteDisconnected, ConnectionError)):
        status(far, f"/{token}")  # This request has no TLS.
    server.stop()


def test_a_port_that_another_program_uses_raises_an_error_with_what_is_allowed() -> None:
    door = Door("127.0.0.1", 0)
    with pytest.raises(
        ConfigError, match=f"cannot listen on 127.0.0.1 port {door.port}: .*allowed: a free port; --web-port 0 "
    ):
        Door("127.0.0.1", door.port)
    with pytest.raises(ConfigError, match="cannot listen on"):  # A run notices this before it builds its controller.
        Page("127.0.0.1", door.port, print)
    door.socket.close()


def test_loopback_is_distinguished_from_other_addresses() -> None:
    assert [is_loopback(host) for host in ("127.0.0.1", "::1", "localhost")] == [True] * 3
    assert not any(map(is_loopback, ("0.0.0.0", "::", "192.168.1.5", "example.org")))
