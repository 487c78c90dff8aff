"""Replace the mount of an arm in the text of a cell. The comments of the text are kept."""

from __future__ import annotations

from collections.abc import Sequence

import yaml

from q2r2_control.errors import ConfigError


def with_mount(text: str, side: str, position: Sequence[float], rpy: Sequence[float]) -> str:
    """Return the YAML ``text`` of a cell with another ``arms.SIDE.mount`` [m, rad].

    Raises:
        ConfigError: If the text has no block for this mount, for example because the mount is an alias.
    """
    node: yaml.Node | None = yaml.compose(text, Loader=yaml.SafeLoader)
    for key in ("arms", side, "mount"):
        node = _child(node, key)
    if not isinstance(node, yaml.MappingNode):
        raise ConfigError(f"arms.{side}.mount: no block of its own; allowed: one, or lines written by hand")
    first = node.value[0][0].start_mark
    between = ", " if node.flow_style else "\n" + " " * first.column
    edits = []
    for key, numbers in (("position", position), ("rpy", rpy)):
        written, value = f"[{', '.join(f'{number:g}' for number in numbers)}]", _child(node, key)
        if value is None:
            edits.append((first.index, first.index, f"{key}: {written}{between}"))
        else:
            start = value.start_mark.index
            edits.append((start, start + len(text[start : value.end_mark.index].rstrip()), written))
    for start, end, written in sorted(edits, reverse=True):
        text = text[:start] + written + text[end:]
    return text


def _child(node: yaml.Node | None, key: str) -> yaml.Node | None:
    """Return the value of a mapping's ``key``.

    The result is None if there is no such key, or if its value is an alias, which stands elsewhere in the text.
    """
    pairs = node.value if isinstance(node, yaml.MappingNode) else []
    return next(
        (value for name, value in pairs if name.value == key and value.start_mark.index >= name.end_mark.index), None
    )
