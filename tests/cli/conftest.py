"""The output of commands does not depend on how busy the machine is."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def _no_notice_of_compiling(monkeypatch: pytest.MonkeyPatch) -> None:
    """It comes after seconds, whatever they are spent on."""
    monkeypatch.setattr("q2r2_control.cli.output._NOTICE_AFTER", 3600.0)
