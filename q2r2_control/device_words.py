"""The operator's words for the controls of an input device, and for their use."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class DeviceWords:
    """Words of one device. A control without a noun is called by its name in the cell's bindings."""

    nouns: Mapping[str, str] = field(default_factory=dict, hash=False)  # Nouns by control.
    verbs: Mapping[str, str] = field(default_factory=dict, hash=False)  # Verbs by control; else "press" or "hold".
    # Text while no device is connected; empty if the device's own controls connect it.
    absent: str = "nothing: no input is connected"
    nobody: str = ""  # Why no person presses anything; empty if a person does.

    def noun(self, control: str) -> str:
        """Return ``control`` with the operator's noun instead of its name. "held" or "button" may follow the name."""
        return re.sub(r"^(\w+)( button)?", lambda found: self.nouns.get(found[1], found[0]), control)

    def press(self, control: str) -> str:
        """Return an instruction to use ``control`` once."""
        return f"{self.verbs.get(control, 'press')} {self.noun(control)}"

    def hold(self, control: str) -> str:
        """Return an instruction to keep ``control`` in use."""
        return f"{self.verbs.get(control, 'hold')} {self.noun(control)}"


NO_WORDS = DeviceWords()  # Every control is called by its name.
QUEST_WORDS = DeviceWords(
    nouns={
        "lower": "A or X",
        "upper": "B or Y",
        "trigger": "the trigger",
        "grip": "the grip",
        "stick_up": "the stick forward",
        "stick_down": "the stick back",
        "stick_left": "the stick to the left",
        "stick_right": "the stick to the right",
    },
    absent="nothing: no headset is connected",
)
