"""Hands that take over the arms whenever they are asked. ``lerobot-rollout`` finds this input by its entry point."""

from __future__ import annotations

from pathlib import Path

from q2r2_control.config.cell import Config
from q2r2_control.types import SIDES, HandInputs, HandSample
from tests.support.hands_input import PRESSED, RELEASED, HandsInput

NAME, READY = "taking_over", "hands: have taken over"
# After a time without a poll that is longer than _ASKED_ANEW [s], the next poll asks the hands to take over. READY is
# printed _LATER [s] after this poll.
_ASKED_ANEW, _LATER = 0.05, 0.3


class TakingOver(HandsInput):
    """Hands that press as soon as they are asked, and then move forwards. A printed line tells when they move."""

    def __init__(self) -> None:
        super().__init__()
        self._since, self._last, self._told = 0.0, -1.0, True

    @classmethod
    def from_config(cls, config: Config) -> TakingOver:
        return cls()

    def poll(self, now: float) -> list[HandSample]:
        if now - self._last > _ASKED_ANEW:
            self._since, self._told = now, False
        self._last, asked = now, now - self._since
        if asked > _LATER and not self._told:
            self._told = True
            print(READY, flush=True)
        inputs = HandInputs(button_lower=PRESSED <= asked < RELEASED)
        samples = [self._sample(hand, inputs, now) for hand in SIDES]
        for sample in samples:
            sample.position[0] = 0.05 * max(asked - RELEASED, 0.0)
        return samples


def installed(folder: Path) -> None:
    """Make the entry point known to programs with ``folder`` on their path."""
    about = folder / f"{NAME}-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {NAME}\nVersion: 1\n")
    (about / "entry_points.txt").write_text(f"[q2r2_control.inputs]\n{NAME} = {__name__}:{TakingOver.__name__}\n")
