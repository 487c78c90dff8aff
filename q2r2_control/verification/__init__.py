"""Whether the controller keeps its promises: checked at every tick, under hostile input and injected faults.

``contract`` is the one checker, for tests, soaks and live runs. ``adversary`` draws streams of targets,
``fault_injection`` uneven ticks, bad starts and failing solvers, and ``soak`` runs a controller through all of them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports

if TYPE_CHECKING:
    from q2r2_control.verification.adversary import Adversary
    from q2r2_control.verification.contract import Contract, Margin
    from q2r2_control.verification.fault_injection import FaultySolver
    from q2r2_control.verification.soak import Soak, SoakReport, run_soak

__all__ = [
    "Adversary",
    "Contract",
    "FaultySolver",
    "Margin",
    "Soak",
    "SoakReport",
    "run_soak",
]

__getattr__ = lazy_exports(
    __name__,
    {
        "Adversary": "adversary",
        "Contract": "contract",
        "FaultySolver": "fault_injection",
        "Margin": "contract",
        "Soak": "soak",
        "SoakReport": "soak",
        "run_soak": "soak",
    },
)
