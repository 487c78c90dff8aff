"""The words by which an operator calls the controls of an input device, and what is done with them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class DeviceWords:
    """Words of one device. A control without a noun is called by its name, as the cell's bindings do."""

    nouns: Mapping[str, str] = field(default_factory=dict, hash=False)  # by control
    verbs: Mapping[str, str] = field(default_factory=dict, hash=False)  # of controls that are neither pressed nor held
    absent: str = "nothing: no input is connected"  # while the device is not there; empty if its controls connect it
    nobody: str = ""  # why no person presses anything; empty if a person does

    def noun(self, control: str) -> str:
        """The operator's word for ``control``, also where `` held`` or `` button`` follows its name."""
        return re.sub(r"^(\w+)( button)?", lambda found: self.nouns.get(found[1], found[0]), control)

    def press(self, control: str) -> str:
        """An instruction to use ``control`` once."""
        return f"{self.verbs.get(control, 'press')} {self.noun(control)}"

    def hold(self, control: str) -> str:
        """An instruction to keep ``control`` in use."""
        return f"{self.verbs.get(control, 'hold')} {self.noun(control)}"


NO_WORDS = DeviceWords()  # every control is called by its name
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
