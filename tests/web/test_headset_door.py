"""Hosts, tokens and certificates decide who may open a headset's page. A headset may also use a USB cable."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from importlib.util import find_spec
from pathlib import Path
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import urlopen

import pytest
from cryptography.x509 import SubjectAlternativeName, load_pem_x509_certificate

from q2r2_control.errors import ConfigError, InputError
from q2r2_control.extras import install_line
from q2r2_control.inputs.webxr.certificate import installation_token, own_certificate
from q2r2_control.inputs.webxr.webxr import _PACKAGES, WebXrInput
from tests.support.processes import cell
from tests.web.headset_page import Listen, refused

ROOT = Path(__file__).resolve().parents[2]


def test_only_the_servers_own_page_can_connect_and_on_other_computers_it_needs_the_token(
    listen: Listen,
) -> None:
    lines: list[str] = []
    near = listen()
    far = listen(host="0.0.0.0", say=lines.append)
    for source in (near, far):
        assert refused(source, origin="http://example.org")
        assert refused(source, origin="null")
        assert not refused(source)
    assert refused(far, query="")
    assert refused(far, query="token=guess")
    assert far.url is not None
    assert far.url.startswith("https://")
    assert any("new certificate, first use" in line for line in lines)
    assert any("▀" in line or "█" in line for line in lines), "a code for a camera"
    # The next run has the same URL and needs no new certificate.
    lines.clear()
    token = urlsplit(far.url).query
    again = listen(host="0.0.0.0", say=lines.append)
    assert again.url is not None
    assert urlsplit(again.url).query == token
    assert not any("certificate" in line for line in lines)


def test_a_token_stays_for_later_runs_but_an_empty_or_cut_token_is_replaced(tmp_path: Path) -> None:
    token = installation_token(tmp_path)
    assert installation_token(tmp_path) == token
    file = tmp_path / "token"
    for text in ("", "\n", token[:-1]):
        file.write_text(text)
        assert len(installation_token(tmp_path)) == len(token)
        assert installation_token(tmp_path) == file.read_text()
    assert file.stat().st_mode & 0o077 == 0, "the token is this user's only"


def test_a_certificate_is_renewed_before_it_expires_or_if_an_address_of_the_server_is_missing_in_it(
    tmp_path: Path,
) -> None:
    now = datetime(2026, 1, 1, tzinfo=UTC)

    def made(address: str, later: int = 0) -> tuple[bytes, str | None]:
        file, line = own_certificate(tmp_path, [address], now + timedelta(days=later))
        assert file.stat().st_mode & 0o077 == 0, "the key is this user's only"
        return file.read_bytes(), line

    first, line = made("192.168.1.5")
    assert "first use" in str(line)
    assert made("192.168.1.5", 300) == (first, None)
    second, line = made("192.168.1.5", 360)
    assert second != first
    assert "expires on 2027-01-01" in str(line)
    third, line = made("10.0.0.7", 360)
    assert "not for 10.0.0.7" in str(line)
    names = load_pem_x509_certificate(third).extensions.get_extension_for_class(SubjectAlternativeName).value
    assert {"10.0.0.7", "127.0.0.1", "localhost"} <= {str(name.value) for name in names}
    (tmp_path / "certificate.pem").write_text("nothing")
    assert "cannot be read" in str(made("10.0.0.7")[1])


def test_each_address_of_this_computer_has_a_url_a_qr_code_and_an_entry_in_the_certificate(
    listen: Listen, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    networks = ("192.168.1.5", "10.0.0.7")
    monkeypatch.setattr("q2r2_control.inputs.webxr.webxr.reachable_addresses", lambda _: networks)
    lines: list[str] = []
    source = listen(host="0.0.0.0", say=lines.append)
    port = source.address[1]
    token = urlsplit(str(source.url)).query
    for address in networks:
        url = f"https://{address}:{port}/?{token}"
        assert f"webxr: open {url}" in lines
        (code,) = (line for line in lines if line.startswith(f"{url}\n"))
        assert "▀" in code or "█" in code
    pem = (tmp_path / "q2r2_control" / "webxr" / "certificate.pem").read_bytes()
    names = load_pem_x509_certificate(pem).extensions.get_extension_for_class(SubjectAlternativeName).value
    assert set(networks) <= {str(name.value) for name in names}


def test_a_headset_on_a_cable_needs_adb_and_an_error_says_what_is_missing(
    listen: Listen, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="adb, which is not installed: apt install adb"):
        listen(by_usb=True)
    adb = tmp_path / "adb"
    adb.write_text("#!/bin/sh\necho 'error: no devices/emulators found' >&2; exit 1\n")
    adb.chmod(0o700)
    with pytest.raises(InputError, match="no devices/emulators found; allowed: one headset in developer mode"):
        listen(by_usb=True)
    asked = tmp_path / "asked"
    adb.write_text(f'#!/bin/sh\necho "$@" >> {asked}\n')
    source = listen(by_usb=True)
    port = source.address[1]
    source.close()
    assert asked.read_text().splitlines() == [f"reverse tcp:{port} tcp:{port}", f"reverse --remove tcp:{port}"]


def status(url: str) -> int:
    try:
        with urlopen(url, timeout=60.0) as response:
            return int(response.status)
    except HTTPError as error:
        return error.code


def test_only_files_of_the_page_are_served(listen: Listen) -> None:
    url = listen().url
    names = ("", "/main.js", "/draw.js", "/style.css")
    assert [status(f"{url}{name}") for name in names] == [200] * 4
    assert status(f"{url}/../server.py") == status(f"{url}/%2e%2e/server.py") == status(f"{url}/__init__.py") == 404


def test_hosts_outside_the_allowed_networks_get_neither_the_page_nor_a_connection(listen: Listen) -> None:
    allow = cell().headset.model_validate({"allow": ["10.0.0.0/8"]}).networks
    source = listen(allow=allow)
    assert status(str(source.url)) == 403
    assert refused(source)


@pytest.mark.parametrize("make", [lambda: WebXrInput().start(), lambda: WebXrInput.from_config(cell())])
@pytest.mark.parametrize("package", _PACKAGES)
def test_a_missing_package_is_named_with_the_extra_that_installs_it(
    package: str, make: Callable[[], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = {name: find_spec(name) for name in _PACKAGES if name != package}
    monkeypatch.setattr("q2r2_control.inputs.webxr.webxr.find_spec", found.get)
    with pytest.raises(InputError, match=re.escape(f"--input webxr needs {package}: {install_line('web')}")):
        make()


def test_the_extra_web_names_all_packages_that_the_page_needs() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    named = {re.split("[<>=]", line)[0] for line in project["optional-dependencies"]["web"]}
    assert named.issuperset(_PACKAGES)


def test_the_error_is_clear_for_a_used_port_and_for_a_cable_with_a_host_and_for_a_bad_certificate(
    listen: Listen,
) -> None:
    source = listen()
    with pytest.raises(InputError, match=r"cannot listen on 127.0.0.1 port .*allowed: a free port"):
        WebXrInput(port=source.address[1]).start()
    with pytest.raises(ConfigError, match=r"--usb with --host 0\.0\.0\.0"):
        WebXrInput.from_config(cell(), host="0.0.0.0", usb=True)
    with pytest.raises(InputError, match=r"--certificate .*allowed: a PEM file"):
        listen(host="0.0.0.0", certificate=Path(__file__))
