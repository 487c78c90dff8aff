"""Where a file of records ends that nobody ended: its writer was killed, or the power was cut."""

from __future__ import annotations

import os
import struct
from typing import BinaryIO

from mcap.writer import MCAP0_MAGIC

_RECORD_HEADER = struct.Struct("<BQ")  # kind and length of a record, before its content


def size_of_whole_records(stream: BinaryIO) -> int:
    """Bytes of a file up to the end of its last whole record; of one that was ended all of it, whatever is in it.

    0: it begins as every file of records does, and has none.
    """
    size = stream.seek(0, os.SEEK_END)
    stream.seek(max(size - len(MCAP0_MAGIC), 0))
    if stream.read() == MCAP0_MAGIC and size > len(MCAP0_MAGIC):
        return size
    stream.seek(0)
    if not MCAP0_MAGIC.startswith(stream.read(len(MCAP0_MAGIC))):
        return size  # another program's
    whole = len(MCAP0_MAGIC)
    while whole + _RECORD_HEADER.size <= size:
        stream.seek(whole)
        _, length = _RECORD_HEADER.unpack(stream.read(_RECORD_HEADER.size))
        if whole + _RECORD_HEADER.size + length > size:
            break
        whole += _RECORD_HEADER.size + length
    return whole if whole > len(MCAP0_MAGIC) else 0
