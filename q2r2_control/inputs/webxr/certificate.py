"""Make this installation's certificate and token at their first use. The private key never leaves its folder."""

from __future__ import annotations

import os
import secrets
import socket
from collections.abc import Sequence
from datetime import datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

from q2r2_control.errors import InputError
from q2r2_control.extras import install_line
from q2r2_control.inputs.addresses import NO_NETWORK

_VALID = timedelta(days=365)  # Time from now to the expiry of a new certificate.
_TOKEN_BYTES, _TOKEN_LENGTH = 16, 22  # Number of random bytes in a token, and length of its text.
_RENEWED = timedelta(days=7)  # A certificate that expires within this time is replaced by a new one.


def installation_folder() -> Path:
    """Return the folder of the certificate and the token, which only this user may read."""
    return Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / "q2r2_control" / "webxr"


def installation_token(folder: Path) -> str:
    """Return the token of the page's URL. It is the same in each run, so that a headset does not need a new URL.

    If the file is too short, for example because the disk was full, its token could open no page. It is then replaced.

    Raises:
        InputError: If the token's file cannot be read or written.
    """
    file = folder / "token"
    try:
        known = file.read_text(encoding="ascii").strip() if file.exists() else ""
        if len(known) < _TOKEN_LENGTH:
            known = secrets.token_urlsafe(_TOKEN_BYTES)
            _write(file, known.encode())
        return known
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"https: {file} cannot be used: {error}; allowed: a file of this user's") from error


def own_certificate(folder: Path, addresses: Sequence[str], now: datetime) -> tuple[Path, str | None]:
    """Return a PEM file with certificate and key for a server at ``addresses``, and a line for people if it is new.

    A new file is made if there is none, if its certificate expires within a week, or if the certificate does not name
    all ``addresses``.

    Raises:
        InputError: If the package cryptography is missing, or if the file cannot be written.
    """
    try:
        from cryptography import x509
    except ImportError as error:
        raise InputError(f"https: it needs cryptography: {install_line('web')}") from error
    file = folder / "certificate.pem"
    names = _names(addresses)
    try:
        if not file.exists():
            why = "first use"
        else:
            known = x509.load_pem_x509_certificate(file.read_bytes())
            alternatives = known.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
            has = {str(name.value) for name in alternatives}
            if known.not_valid_after_utc < now + _RENEWED:
                why = f"the last one expires on {known.not_valid_after_utc:%Y-%m-%d}"
            elif missing := [name for name in names if name not in has]:
                why = f"the last one is not for {', '.join(missing)}"
            else:
                return file, None
    except (OSError, ValueError, x509.ExtensionNotFound) as error:
        why = f"the last one cannot be read ({error})"
    try:
        _write(file, _made(names, now))
    except OSError as error:
        raise InputError(
            f"https: {file} cannot be written: {error.strerror}; allowed: a folder of this user's"
        ) from error
    return file, f"new certificate, {why}: each browser asks once whether to trust it"


def _names(addresses: Sequence[str]) -> list[str]:
    host = socket.gethostname().partition(".")[0]
    known = [address for address in addresses if address != NO_NETWORK]
    return list(dict.fromkeys((*known, f"{host}.local", host, "localhost", "127.0.0.1", "::1")))


def _made(names: list[str], now: datetime) -> bytes:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.hazmat.primitives.hashes import SHA256
    from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"q2r2_control on {socket.gethostname()}"[:64])])
    made = (
        x509.CertificateBuilder(subject, subject, key.public_key(), x509.random_serial_number())
        # The certificate is valid from yesterday on, because the clock of a headset can be behind.
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + _VALID)
        .add_extension(x509.SubjectAlternativeName([_general_name(name) for name in names]), critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .sign(key, SHA256())
    )
    private = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    return private + made.public_bytes(Encoding.PEM)


def _general_name(name: str) -> object:
    from cryptography import x509

    try:
        return x509.IPAddress(ip_address(name))
    except ValueError:
        return x509.DNSName(name)


def _write(file: Path, content: bytes) -> None:
    """Write a file that only this user can read. If the writing fails, the old file stays as it was."""
    file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    temporary = file.with_suffix(f".{os.getpid()}")
    with open(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as stream:
        stream.write(content)
    temporary.replace(file)
