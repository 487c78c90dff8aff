"""Two hosts that one network joins, as namespaces of this machine, with a cable that can be pulled."""

from __future__ import annotations

import os
import subprocess
from types import TracebackType

_SUBNET = "10.79.0"  # seen by these namespaces only


class NotPermittedError(Exception):
    """Network namespaces cannot be made here; the message says what failed."""


class TwoHosts:
    """Hosts ``robot`` and ``operator`` with a switch between them, which is a third namespace.

    A pulled cable takes away the carrier and leaves the hosts' own addresses alone, as it does on real ones.
    """

    def __init__(self) -> None:
        self._names = {name: f"q2r2-{os.getpid()}-{name}" for name in ("switch", "robot", "operator")}

    def __enter__(self) -> TwoHosts:
        try:
            for name in self._names.values():
                _run("netns", "add", name)
            self._in("switch", "link", "add", "bridge", "type", "bridge")
            self._in("switch", "link", "set", "bridge", "up")
            for number, host in enumerate(("robot", "operator"), start=1):
                self._connect(host, f"{_SUBNET}.{number}/24")
        except NotPermittedError:
            self._remove()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._remove()

    def on(self, host: str, *command: str) -> tuple[str, ...]:
        """What runs a command on a host."""
        return "ip", "netns", "exec", self._names[host], *command

    def pull_cable(self) -> None:
        """Part the hosts."""
        self._in("switch", "link", "set", "robot", "down")

    def plug_cable(self) -> None:
        """Join them again."""
        self._in("switch", "link", "set", "robot", "up")

    def _connect(self, host: str, address: str) -> None:
        self._in("switch", "link", "add", host, "type", "veth", "peer", "name", "eth", "netns", self._names[host])
        self._in("switch", "link", "set", host, "master", "bridge", "up")
        self._in(host, "link", "set", "lo", "up")
        self._in(host, "address", "add", address, "dev", "eth")
        self._in(host, "link", "set", "eth", "up")
        self._in(host, "route", "add", "224.0.0.0/4", "dev", "eth")  # of discovery

    def _in(self, host: str, *arguments: str) -> None:
        _run("-n", self._names[host], *arguments)

    def _remove(self) -> None:
        for name in self._names.values():
            subprocess.run(["ip", "netns", "delete", name], capture_output=True, check=False)


def _run(*arguments: str) -> None:
    command = ["ip", *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        raise NotPermittedError("there is no ip command") from None
    if done.returncode:
        raise NotPermittedError(f"{' '.join(command)}: {done.stderr.strip()}")
