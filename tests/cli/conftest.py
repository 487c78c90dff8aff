"""Fixtures for commands: no notices about the cache of kernels, and simulated KUKA cabinets."""

from __future__ import annotations

import math
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def _no_notice_of_compiling(monkeypatch: pytest.MonkeyPatch) -> None:
    """Any test may have to compile kernels, so notices about this are switched off."""
    monkeypatch.setattr("q2r2_control.cli.output.compiling", nullcontext)


@pytest.fixture(autouse=True)
def _no_lines_of_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """A command that takes long on a busy computer prints lines about its progress, so these are switched off."""
    monkeypatch.setattr("q2r2_control.cli.output._BETWEEN_LINES_S", math.inf)


@pytest.fixture
def fri_cell(tmp_path: Path) -> str:
    """Return the shipped cell with cabinets, on free ports."""
    text = Path("config/dual_iiwa7_fri.yaml").read_text(encoding="utf-8")
    for port in ("30200", "30201"):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            text = text.replace(f"port: {port}", f"port: {free.getsockname()[1]}")
    (file := tmp_path / "cell.yaml").write_text(text, encoding="utf-8")
    return str(file)


@pytest.fixture
def cabinets(fri_cell: str) -> Iterator[None]:
    """Run the simulated cabinets of ``fri_cell`` in a separate process."""
    command = (sys.executable, "-m", "q2r2_control", "fri-cabinet", fri_cell)
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    assert "monitoring wait" in process.stderr.readline()
    yield
    process.terminate()
    process.communicate()
