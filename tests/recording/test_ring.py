"""What is put into a ring is what is taken out of it, however often it goes round."""

from __future__ import annotations

import os

import numpy as np
import pytest

from q2r2_control.recording.ring import Ring, new_memory


def both_sides(size: int) -> tuple[Ring, Ring]:
    memory = new_memory(size)
    sides = Ring(memory), Ring(memory)
    os.close(memory)
    return sides


def test_records_of_any_length_come_out_as_they_went_in() -> None:
    loop, writer = both_sides(4096)
    rng = np.random.default_rng(1)
    put: list[bytes] = []
    taken: list[bytes] = []
    while len(put) < 3000:
        record = rng.bytes(int(rng.integers(0, 700)))
        if loop.put(record):
            put.append(record)
        else:
            taken += writer.take(int(rng.integers(1, 9)))
            writer.release()
    loop.finish()
    taken += writer.take(len(put))
    assert taken == put


def test_a_full_ring_takes_no_more_until_there_is_room_and_keeps_what_it_has() -> None:
    loop, writer = both_sides(1024)
    record = bytes(range(248))
    assert [loop.put(record) for _ in range(5)] == [True, True, True, True, False]
    loop.finish()
    assert writer.take(1) == [record]
    assert not loop.put(record), "what was taken is still in use"
    writer.release()
    assert loop.put(bytes(248))
    assert not loop.put(record)
    assert writer.take(9) == [record] * 3, "the last one comes with the next, or at the end"
    loop.finish()
    assert writer.take(9) == [bytes(248)]


def test_a_record_that_never_fits_is_an_error() -> None:
    loop, _ = both_sides(1024)
    with pytest.raises(ValueError, match="a record of 2000 bytes: allowed: at most 1016"):
        loop.put(bytes(2000))


def test_how_much_was_written_is_known_on_the_other_side() -> None:
    loop, writer = both_sides(1024)
    writer.written = 70_000
    assert loop.written == 70_000
