"""Two-armed work motions through the whole stack, from hand samples to arms in MuJoCo, for each mode asked for.

Beside each stands the same motion with the same samples in free air, where nothing is watched: what is worse than that,
the pairs cost.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from q2r2_control.benchmark.stack_run import Stack, StackFigures
from q2r2_control.config.cell import Config
from q2r2_control.types import CommandMode
from q2r2_control.verification.work_motions import WorkMotion


@dataclass(frozen=True, slots=True)
class StackRow:
    """One motion: each mode, and the same in free air."""

    motion: str
    about: str
    reachable: bool  # whether both arms can be at all targets with every distance kept
    figures: list[StackFigures]
    free_air: list[StackFigures]


@dataclass(frozen=True, slots=True)
class StackReport:
    """All motions on one cell."""

    cell: str
    pairs: int
    loop_rate_hz: float
    seed: int
    rows: list[StackRow]

    @property
    def passed(self) -> bool:
        """Whether every motion came to its end, with every promise kept at every tick."""
        return all(figures.passed for row in self.rows for figures in row.figures)

    def as_json(self) -> dict[str, Any]:
        """Data for ``json.dumps``."""
        return asdict(self) | {"passed": self.passed}


def run_stack_bench(
    config: Config,
    motions: Sequence[WorkMotion],
    modes: Sequence[CommandMode],
    seed: int = 0,
    progress: Callable[[str], None] = lambda what: None,
) -> StackReport:
    """Run ``motions``, which are made for ``config/dual_iiwa7.yaml``, in each of ``modes``."""
    stacks = [Stack(config, mode) for mode in modes]
    free = [Stack(config, mode, free=True) for mode in modes]
    rows = []
    for number, motion in enumerate(motions, 1):
        figures: list[list[StackFigures]] = [[], []]
        for results, group, place in zip(figures, (stacks, free), ("", ", free air"), strict=True):
            for stack in group:
                progress(f"{motion.name} ({number} of {len(motions)}), {stack.mode}{place}")
                results.append(stack.run(motion, seed))
        rows.append(StackRow(motion.name, motion.about, motion.reachable, *figures))
    pairs = len(stacks[0].robot.collision_model.collisionPairs) if stacks else 0
    return StackReport(config.name, pairs, config.loop_rate_hz, seed, rows)
