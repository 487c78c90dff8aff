"""A measured mount is written into the text of a cell."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from q2r2_control.config.mount_text import with_mount
from q2r2_control.errors import ConfigError

SHIPPED = Path("config/dual_iiwa7_fri.yaml").read_text(encoding="utf-8")
POSITION, RPY = [0.01, -0.42, 0.003], [0.0, 0.01, 1.5]


def arms(*mounts: str) -> str:
    return "arms:\n" + "".join(f"  {side}:\n{mount}" for side, mount in zip(("left", "right"), mounts, strict=True))


@pytest.mark.parametrize(
    "text",
    [
        pytest.param(SHIPPED, id="the shipped cell, without rpy"),
        pytest.param(arms("    mount: {}\n", "    mount: {rpy: [0, 0, 1]}  # measured\n"), id="on one line"),
        pytest.param(
            arms(
                "    mount: {}\n",
                "    mount:\n      rpy:\n        - 1\n        - 2\n        - 3\n      position: [1, 2, 3]\n",
            ),
            id="in blocks",
        ),
    ],
)
def test_the_mount_is_replaced_and_all_other_keys_and_comments_stay(text: str) -> None:
    changed = with_mount(text, "right", POSITION, RPY)
    expected = yaml.safe_load(text)
    expected["arms"]["right"]["mount"] = {"position": POSITION, "rpy": RPY}
    assert yaml.safe_load(changed) == expected
    assert changed.count("#") == text.count("#")


@pytest.mark.parametrize(
    "text",
    [
        pytest.param(arms("    mount: {}\n", "    home: [0]\n"), id="missing"),
        pytest.param(arms("    mount: &m {position: [1, 2, 3]}\n", "    mount: *m\n"), id="another arm's too"),
        pytest.param("[]", id="no cell"),
    ],
)
def test_a_mount_is_refused_if_the_file_has_no_mount_block_for_only_this_arm(text: str) -> None:
    with pytest.raises(ConfigError, match=r"arms\.right\.mount: no block of its own"):
        with_mount(text, "right", POSITION, RPY)
