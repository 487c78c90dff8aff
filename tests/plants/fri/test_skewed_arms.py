"""Two arms swing together near each other, each behind its cabinet. One of them lags or stops alone."""

from __future__ import annotations

import pytest

from tests.plants.fri.skewed_arms import CASES, Case

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("case", CASES)
def test_measured_arms_keep_their_distance_in_every_incident_that_happens_to_one_arm(case: str) -> None:
    found = Case(case, 0.5).run()
    assert found.speed > 0.35
    assert found.margin >= 0.0
    assert found.error < 0.02 or case == "answers 0.25 s apart", "they are followed as long as they are together"


@pytest.mark.parametrize("case", ["cable pulled", "pendant stopped"])
def test_both_arms_rest_within_0_2_s_after_one_of_them_was_disconnected_or_stopped(case: str) -> None:
    assert Case(case, 0.5).run().rest < 0.2
