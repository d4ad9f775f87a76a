"""Reads MCAP files by the format's specification alone, without the library that writes ours.

Knows: records, chunks, schemas, channels, messages; checksums and the summary's count are held against what was read.
Does not know: what is in a message.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import zstandard

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, STATISTICS = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0B


class Words:
    """Fields of a record, one after another."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def numbers(self, layout: str) -> tuple[Any, ...]:
        found = struct.unpack_from(f"<{layout}", self._data, self._at)
        self._at += struct.calcsize(f"<{layout}")
        return found

    def text(self) -> str:
        (length,) = self.numbers("I")
        return self.rest(length).decode()

    def rest(self, length: int | None = None) -> bytes:
        end = len(self._data) if length is None else self._at + length
        found, self._at = self._data[self._at : end], end
        assert len(found) == end - (self._at - len(found))
        return found


def records(data: bytes) -> Iterator[tuple[int, Words]]:
    """(kind, fields) of each record."""
    at = 0
    while at < len(data):
        kind, length = struct.unpack_from("<BQ", data, at)
        yield kind, Words(data[at + 9 : at + 9 + length])
        at += 9 + length
    assert at == len(data), "a torn record"


def unpacked(chunk: Words) -> bytes:
    """The records of a chunk."""
    _, _, size, checksum = chunk.numbers("QQQI")
    compression = chunk.text()
    (length,) = chunk.numbers("Q")
    assert compression in ("", "zstd")
    packed = chunk.rest(length)
    data = zstandard.ZstdDecompressor().decompress(packed, max_output_size=size) if compression else packed
    assert len(data) == size
    assert zlib.crc32(data) == checksum
    return data


def read_mcap(file: Path) -> list[tuple[str, str, int, bytes]]:
    """(topic, name of its schema, nanoseconds since 1970, data) of every message, as they were written."""
    data = file.read_bytes()
    assert data.startswith(MAGIC)
    assert data.endswith(MAGIC)
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    found, told, is_footed = [], -1, False
    body = [(kind, words) for kind, words in records(data[len(MAGIC) : -len(MAGIC)])]
    flat = [one for kind, words in body for one in (records(unpacked(words)) if kind == CHUNK else [(kind, words)])]
    for kind, words in flat:
        if kind == SCHEMA:
            (number,) = words.numbers("H")
            schemas[number] = words.text()
        elif kind == CHANNEL:
            number, schema = words.numbers("HH")
            channels[number] = words.text(), schemas[schema]
        elif kind == MESSAGE:
            number, _, at_ns, _ = words.numbers("HIQQ")
            found.append((*channels[number], at_ns, words.rest()))
        elif kind == STATISTICS:
            (told,) = words.numbers("Q")
        is_footed |= kind == FOOTER
    assert is_footed
    assert told == len(found)
    return found
