"""Notes about a kernel or a network card that may delay answers to a robot, from files, ``ip`` and ``ethtool``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from q2r2_control.process.machine_notes import card_notes, fair_server_notes, network_notes

QUIET = "Adaptive RX: off  TX: off\nrx-usecs: 0\nrx-frames: 1\n"
RING = "Pre-set maximums:\nRX:\t\t4096\nTX:\t\t4096\nCurrent hardware settings:\nRX:\t\t{}\nTX:\t\t256\n"


@pytest.fixture
def prints(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Replace the computer's ``ethtool`` by a script that prints the given texts ``gathers`` and ``rings``."""

    def put(gathers: str = QUIET, rings: str = RING.format(4096)) -> None:
        (tmp_path / "-c").write_text(gathers)
        (tmp_path / "-g").write_text(rings)
        (tool := tmp_path / "ethtool").write_text(f'#!/bin/sh\nexec cat "{tmp_path}/$1"\n')
        tool.chmod(0o755)
        monkeypatch.setenv("PATH", str(tmp_path), prepend=":")

    return put


def test_there_is_no_note_about_a_card_that_forwards_every_message_at_once(prints: Callable[..., None]) -> None:
    prints()
    assert card_notes("lo") == []


@pytest.mark.parametrize("gathers", ["Adaptive RX: off  TX: off\nrx-usecs: 50\n", "Adaptive RX: on  TX: off\n"])
def test_a_note_names_a_card_that_gathers_messages_and_the_command_that_stops_this(
    prints: Callable[..., None], gathers: str
) -> None:
    prints(gathers)
    (note,) = card_notes("lo")
    assert note.endswith("ethtool -C lo adaptive-rx off rx-usecs 0")


def test_a_note_names_a_card_with_a_short_ring_buffer_and_the_command_that_lengthens_the_buffer(
    prints: Callable[..., None],
) -> None:
    prints(rings=RING.format(256))
    assert card_notes("lo") == ["lo: a ring buffer of 256 messages; ethtool -G lo rx 4096"]


def test_there_is_no_note_about_a_card_about_which_nothing_is_known(prints: Callable[..., None]) -> None:
    prints("rx-usecs: n/a\n", "RX:\t\tn/a\nRX:\t\tn/a\n")
    assert card_notes("no_such_card") == []


def test_there_is_no_note_about_a_network_card_for_addresses_of_this_computer() -> None:
    assert network_notes(["127.0.0.1", "::1"]) == []


@pytest.mark.parametrize(
    ("release", "shares", "is_noted"),
    [
        ("6.12.0-rt5", "50000000", True),
        ("6.12.0", None, True),  # This user has no permission to read the file.
        ("6.18.44", "0", False),
        ("6.8.0-48-generic", None, False),
    ],
)
def test_a_note_names_a_kernel_that_throttles_real_time_threads_for_other_programs(
    tmp_path: Path, release: str, shares: str | None, is_noted: bool
) -> None:
    for cpu in ("cpu0", "cpu1") if shares is not None else ():
        (tmp_path / cpu).mkdir()
        (tmp_path / cpu / "runtime").write_text(f"{shares}\n")
    notes = fair_server_notes(release, tmp_path)
    assert [note.endswith(f": echo 0 | tee {tmp_path}/cpu*/runtime") for note in notes] == [True] * is_noted
