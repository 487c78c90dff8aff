"""The shipped cell with pairs that may touch, which by itself it has none of."""

from __future__ import annotations

from q2r2_control.config.cell import Config
from q2r2_control.config.control import ContactPair

TABLE_ONLY = (ContactPair(pair=("*_finger_*", "table")),)
FINGERS = (*TABLE_ONLY, ContactPair(pair=("left_*_finger_*", "right_*_finger_*"), depth=0.005))


def with_contact(config: Config, pairs: tuple[ContactPair, ...]) -> Config:
    """The cell as it is where it allows contact, else with ``pairs`` that may touch."""
    if config.control.contact_allowed:
        return config
    return config.model_copy(update={"control": config.control.model_copy(update={"contact_allowed": pairs})})
