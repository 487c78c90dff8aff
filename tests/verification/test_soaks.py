"""Soaks with several seeds have one report, which joins the reports of the single soaks."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from q2r2_control.process.places import HERE
from q2r2_control.verification.promises import Margin
from q2r2_control.verification.soak import SoakReport, Violation, run_soak
from q2r2_control.verification.soaks import joined, run_soaks
from tests.support.processes import cell

TICKS = 100


def margin(worst: float, tick: int, violations: int = 0) -> Margin:
    found = Margin("speed", "m/s", "<=", 1.0, tick, 10, violations)
    found.worst = worst
    return found


def report(seed: int, **changes: object) -> SoakReport:
    plain = SoakReport("cell", "daqp", seed, TICKS, 0.1, {"resets": 2}, [margin(0.5, 7)], 1.0, [])
    return replace(plain, **changes)  # type: ignore[arg-type]


def violation(promise: str, seed: int) -> Violation:
    return Violation(promise, seed, 3, "walk", 1, np.zeros(2), np.zeros(2), {}, "0.001", "")


def test_the_report_on_two_soaks_has_the_sums_of_their_counts_and_their_worst_margins() -> None:
    lines: list[str] = []
    both = run_soaks(cell(), TICKS, range(3, 5), HERE, progress=lines.append)
    first, second = (run_soak(cell(), TICKS, seed) for seed in (3, 4))
    assert (both.seed, both.seeds, both.ticks, both.passed) == (3, 2, 2 * TICKS, True)
    assert both.counts == {name: first.counts[name] + second.counts[name] for name in first.counts}
    for found, one, other in zip(both.margins, first.margins, second.margins, strict=True):
        assert found.checked == one.checked + other.checked
        assert found.worst == (max if found.sense == "<=" else min)(one.worst, other.worst)
    assert lines == ["seed 3: passed", "seed 4: passed"]


def test_the_first_violation_of_each_promise_is_kept_with_its_seed() -> None:
    broken = [violation("room", 1)], [violation("speed", 2), violation("room", 2)]
    found = joined([report(0), *(report(seed, broken=its) for seed, its in enumerate(broken, start=1))])
    assert [(one.promise, one.seed) for one in found.broken] == [("room", 1), ("speed", 2)]


def test_the_value_nan_stays_the_worst_value_and_the_largest_growth_of_memory_is_kept() -> None:
    values = [margin(0.9, 1), margin(math.nan, 2, 1), margin(0.99, 3)]
    growths = (0.5, 2.5, 1.0)
    reports = [report(seed, margins=[values[seed]], memory_growth_mb=growths[seed]) for seed in range(3)]
    found = joined(reports)
    assert math.isnan(found.margins[0].worst)
    assert (found.margins[0].tick, found.margins[0].violations, found.memory_growth_mb) == (2, 1, 2.5)
    assert not found.passed
    assert values[0].checked == 10  # The single reports are not changed.
    assert joined([*reports, report(3, memory_growth_mb=None)]).memory_growth_mb is None
