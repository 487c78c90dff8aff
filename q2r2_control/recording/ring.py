"""Records from one process to another through memory that both map. Neither ever waits for the other.

The memory has no name (memfd), so nothing of it is left when both have ended, however they did. Each side writes
counters of its own only, and both only grow. A counter is moved when the next record is put, or when all of what was
taken is used up: a tick later, so that on processors that reorder stores (ARM) too the other side sees no counter
before the bytes that it stands for.
"""

from __future__ import annotations

import mmap
import os
import sys
import tempfile

# Places of the counters, as numbers of 8 bytes, in cache lines of their own.
_PUT, _TAKEN, _WRITTEN = 0, 8, 16
_HEAD = 256  # bytes before the records
_LENGTH = 8  # bytes before each record


def new_memory(size: int) -> int:
    """File descriptor of memory for a :class:`Ring` with ``size`` bytes for records. Raises :class:`OSError`."""
    if sys.platform == "linux":
        fd = os.memfd_create("q2r2-recording")
    else:
        with tempfile.TemporaryFile() as file:
            fd = os.dup(file.fileno())
    try:
        os.ftruncate(fd, _HEAD + size // _LENGTH * _LENGTH)
    except OSError:
        os.close(fd)
        raise
    return fd


class Ring:
    """One side of it: the loop puts, the writer takes and releases."""

    def __init__(self, fd: int) -> None:
        """Map all of it at once, so that the loop meets no page that is not there yet; ``fd`` may be closed then."""
        flags = mmap.MAP_SHARED | getattr(mmap, "MAP_POPULATE", 0)
        memory = memoryview(mmap.mmap(fd, 0, flags=flags))
        self._counters = memory[:_HEAD].cast("Q")
        self._data = memory[_HEAD:]
        self._lengths = self._data.cast("Q")
        self._size = len(self._data)
        self._at = 0  # where this side is, in bytes since the beginning

    @property
    def written(self) -> int:
        """How many ticks are in the file, as the writer counts them."""
        return self._counters[_WRITTEN]

    @written.setter
    def written(self, count: int) -> None:
        self._counters[_WRITTEN] = count

    @property
    def progress(self) -> tuple[int, int]:
        """What changes while the writer gets on: bytes taken and ticks written."""
        return self._counters[_TAKEN], self._counters[_WRITTEN]

    def put(self, record: bytes) -> bool:
        """Add a record; False where there is no room now. Raises :class:`ValueError` for one that never fits."""
        length = len(record)
        size = _size_of(length)
        if size > self._size - (self._at - self._counters[_TAKEN]):
            if size > self._size:
                raise ValueError(f"a record of {length} bytes: allowed: at most {self._size - _LENGTH}")
            return False
        self._counters[_PUT] = self._at
        begin = self._at % self._size
        self._lengths[begin // _LENGTH] = length
        begin = (begin + _LENGTH) % self._size
        end = begin + length
        if end <= self._size:
            self._data[begin:end] = record
        else:
            cut = self._size - begin
            self._data[begin:] = record[:cut]
            self._data[: length - cut] = record[cut:]
        self._at += size
        return True

    def finish(self) -> None:
        """Let the other side have the last record too."""
        self._counters[_PUT] = self._at

    def take(self, most: int) -> list[bytes]:
        """Up to ``most`` of the next records; their room is kept until :meth:`release`."""
        records: list[bytes] = []
        end = self._counters[_PUT]
        while self._at < end and len(records) < most:
            begin = self._at % self._size
            length = self._lengths[begin // _LENGTH]
            begin = (begin + _LENGTH) % self._size
            first = bytes(self._data[begin : begin + length])
            records.append(first if len(first) == length else first + bytes(self._data[: length - len(first)]))
            self._at += _size_of(length)
        return records

    def release(self) -> None:
        """Give back the room of what was taken."""
        self._counters[_TAKEN] = self._at


def _size_of(length: int) -> int:
    """Bytes that a record takes, so that each begins at a multiple of the length's own size."""
    return _LENGTH + -(-length // _LENGTH) * _LENGTH
