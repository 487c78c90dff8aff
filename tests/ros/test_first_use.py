"""The first start of nodes builds message packages, or says why it cannot. No test here needs ROS."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from unittest.mock import MagicMock

import pytest

from q2r2_control.extras import install_line
from q2r2_control.ros.launch import build, processes
from q2r2_control.ros.launch.build import BuildError, Interfaces, build_missing
from q2r2_control.ros.launch.processes import UpError, run_together


@pytest.fixture
def built(monkeypatch: pytest.MonkeyPatch) -> MagicMock:
    """A replacement for the build, which takes minutes."""
    monkeypatch.setattr(build, "build_interfaces", made := MagicMock())
    return made


def needs(monkeypatch: pytest.MonkeyPatch, package: str) -> None:
    monkeypatch.setattr(build, "interface_packages", lambda: [Interfaces(Path(package))])


def test_nodes_without_rclpy_are_refused_in_one_line_that_says_how_to_install_it(
    monkeypatch: pytest.MonkeyPatch, built: MagicMock
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UpError, match=rf"^rclpy cannot be imported: .*{re.escape(install_line('ros'))}"):
        run_together([MagicMock()], print)
    assert not built.called


def test_message_packages_are_built_only_if_one_is_missing(monkeypatch: pytest.MonkeyPatch, built: MagicMock) -> None:
    needs(monkeypatch, "json")
    build_missing(said := MagicMock())
    assert not built.called
    assert not said.called
    needs(monkeypatch, "no_such_messages")
    build_missing(said)
    built.assert_called_once_with(said)
    said.assert_called_once_with("building message packages, once for this environment")


def test_no_node_starts_if_message_packages_cannot_be_built(monkeypatch: pytest.MonkeyPatch, built: MagicMock) -> None:
    needs(monkeypatch, "no_such_messages")
    monkeypatch.setattr(processes, "check_rclpy", lambda: None)
    built.side_effect = BuildError("quest2ros not built: missing a C++ compiler")
    with pytest.raises(BuildError, match="missing a C"):
        run_together([node := MagicMock()], print)
    assert not node.command.called
