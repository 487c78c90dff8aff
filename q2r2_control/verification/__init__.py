"""Whether the controller keeps its promises: checked at every tick, under hostile input and injected faults.

``contract`` is the one checker, for tests, soaks and live runs. ``adversary`` draws streams of targets,
``fault_injection`` uneven ticks, bad starts and failing solvers, and ``soak`` runs a controller through all of them.
``work_motions`` is the other side: what two arms do at work, for figures of how well they do it, and ``work_hands`` the
operator who makes them do it. ``assembly_tasks`` are the demo's, with real contacts: ``part_judges`` say whether they
succeeded, by what ``touch_watch`` sees.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports

if TYPE_CHECKING:
    from q2r2_control.verification.adversary import Adversary
    from q2r2_control.verification.contract import Contract
    from q2r2_control.verification.fault_injection import FaultySolver
    from q2r2_control.verification.promises import Margin
    from q2r2_control.verification.soak import Soak, SoakReport, run_soak
    from q2r2_control.verification.work_hands import WorkHands
    from q2r2_control.verification.work_motions import WORK_MOTIONS, WorkMotion, motions_named

__all__ = [
    "WORK_MOTIONS",
    "Adversary",
    "Contract",
    "FaultySolver",
    "Margin",
    "Soak",
    "SoakReport",
    "WorkHands",
    "WorkMotion",
    "motions_named",
    "run_soak",
]

__getattr__ = lazy_exports(
    __name__,
    {
        "Adversary": "adversary",
        "Contract": "contract",
        "FaultySolver": "fault_injection",
        "Margin": "promises",
        "Soak": "soak",
        "SoakReport": "soak",
        "WORK_MOTIONS": "work_motions",
        "WorkHands": "work_hands",
        "WorkMotion": "work_motions",
        "motions_named": "work_motions",
        "run_soak": "soak",
    },
)
