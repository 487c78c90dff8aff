"""Soaks with several seeds, which several processes or machines run, and one report on all of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from copy import copy
from dataclasses import replace
from functools import partial

from q2r2_control.config.cell import Config
from q2r2_control.process.places import JobPlace
from q2r2_control.verification.policy_soak import PolicySoak
from q2r2_control.verification.promises import Margin
from q2r2_control.verification.soak import SoakReport, Violation, run_soak


def run_soaks(
    config: Config,
    ticks: int,
    seeds: Sequence[int],
    place: JobPlace,
    *,
    policy: bool = False,
    progress: Callable[[str], None] = lambda what: None,
) -> SoakReport:
    """Run a soak of ``ticks`` ticks with each of one or more ``seeds``.

    If ``policy`` is True, a hostile policy moves the arms through the whole pipeline. The report does not depend on the
    ``place`` where the soaks run, except for the growth of memory, which is measured.
    """
    reports = []
    with closing(place.results(partial(soak_with, config, ticks, policy), seeds)) as results:
        for report in results:
            reports.append(report)
            progress(f"seed {report.seed}: {'passed' if report.passed else 'broken'}{place.where}")
    return joined(reports)


def soak_with(config: Config, ticks: int, policy: bool, seed: int) -> SoakReport:
    """Run one soak. This is a function of a module, so that other processes and machines can call it."""
    return PolicySoak(config, seed).run(ticks) if policy else run_soak(config, ticks, seed)


def joined(reports: Sequence[SoakReport]) -> SoakReport:
    """Return one report on soaks of the same cell: sums of counts, and the worst of all margins and growths."""
    first, counts = reports[0], Counter[str]()
    for report in reports:
        counts.update(report.counts)
    broken: dict[str, Violation] = {}
    for found in (found for report in reports for found in report.broken):
        broken.setdefault(found.promise, found)
    growths = [report.memory_growth_mb for report in reports if report.memory_growth_mb is not None]
    return replace(
        first,
        ticks=sum(report.ticks for report in reports),
        simulated_s=sum(report.simulated_s for report in reports),
        counts=dict(counts),
        margins=[_worst(margins) for margins in zip(*(report.margins for report in reports), strict=True)],
        memory_growth_mb=max(growths) if len(growths) == len(reports) else None,
        broken=list(broken.values()),
        seeds=len(reports),
    )


def _worst(margins: Sequence[Margin]) -> Margin:
    worst = copy(margins[0])
    for margin in margins[1:]:
        worst.add(margin)
    return worst
