"""A hostile policy breaks no promise. If a check of actions is missing, the soak finds a broken promise."""

from __future__ import annotations

import pytest

from q2r2_control.verification.policy_soak import PolicySoak
from tests.cli.command import q2r2
from tests.support.processes import cell

pytestmark = pytest.mark.slow


def test_no_hostile_action_breaks_a_promise_and_the_arms_rest_after_each_stall() -> None:
    report = PolicySoak(cell(), seed=1).run(7500)
    assert report.broken == []
    assert report.passed
    assert min(report.counts[name] for name in ("chunks", "policy_ticks", "begins", "stops", "stalls")) > 0


def test_the_soak_finds_that_the_last_action_of_a_stalled_policy_is_repeated_for_too_long(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("q2r2_control.teleop.policy_motion.SILENT", 10.0)
    report = PolicySoak(cell(), seed=0, streams=("walk", "stall")).run(5500)
    assert [found.promise for found in report.broken] == ["speed after a stall of the policy"]
    assert not report.passed


def test_the_command_soak_prints_every_promise_and_the_number_of_actions() -> None:
    result = q2r2("soak", "--policy", "--ticks", "300")
    assert result.exit_code == 0
    assert "speed after a stall of the policy" in result.stdout
    assert "chunks of actions" in result.stdout
