"""Data compressed by Apple's LZFSE, bounded before it is decoded.

The library that decodes takes no limit. So the headers of the blocks are read beforehand: what they state must be the
size that is wanted, and what they could expand to at most must be within bounds.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from bask_data.errors import BadData, imported

MAX_EXPANDED = 512 * 2**20
"""Most bytes that the blocks could expand to. The headers of a depth image of 640 x 480 allow about 160 MB, although it
has 1.2 MB, as every match may be as long as the longest."""

LONGEST_MATCH = 2359
"""Most bytes that a match of an LZFSE block copies: the largest base value and 11 bits more, in its reference code."""

MOST_LITERALS = 40_064
"""Most bytes that an LZFSE block holds besides matches: 40 000 and what the reference code reads ahead."""

MOST_MATCHES = 10_000
"""Most matches of an LZFSE block, by its reference code."""


def decode_lzfse(where: Path | str, data: bytes, n_bytes: int, *, user: str) -> bytes:
    """The decoded data, or the data itself if it is not compressed.

    Args:
        where: place for messages.
        n_bytes: size of the decoded data.
        user: the command or format that needs it, for messages.

    Raises:
        BadData: the data is no LZFSE stream, is damaged, or has another size.
        MissingDependency: the library that decodes it is not installed.
    """
    if len(data) == n_bytes and not data.startswith(b"bvx"):
        return data
    stated = stated_size(where, data)
    if stated == n_bytes:
        lzfse = imported("lzfse", "LZFSE", user=user, extra="formats")
        try:
            decoded: bytes = lzfse.decompress(data)
        except (lzfse.error, MemoryError) as error:
            raise _damaged(where, "blocks that do not decode") from error
        if len(decoded) == n_bytes:
            return decoded
        stated = len(decoded)
    raise BadData(where, "size", expected=f"{n_bytes} bytes when decoded", got=str(stated))


def stated_size(where: Path | str, data: bytes) -> int:
    """Size of the decoded data by the headers of its blocks.

    Raises:
        BadData: the data is no LZFSE stream, is cut short, or could expand to more than `MAX_EXPANDED`.
    """
    try:
        blocks = list(_blocks(data))
    except (ValueError, struct.error):
        raise _damaged(where, f"bytes {data[:8]!r}..., {len(data)} in all") from None
    if (most := sum(block.most for block in blocks)) > MAX_EXPANDED:
        raise BadData(where, "size", expected=f"at most {MAX_EXPANDED} bytes when decoded", got=f"up to {most}")
    return sum(block.stated for block in blocks)


@dataclass(frozen=True)
class _Block:
    """Sizes of a decoded block, bytes: as its header states it, and the most that it could be."""

    stated: int
    most: int


def _blocks(data: bytes) -> Iterator[_Block]:
    """Headers of an LZFSE stream; `ValueError` or `struct.error` if it is none, or cut short."""
    # The library reads 12 bytes before it looks at the length.
    if len(data) < 12:
        raise ValueError
    position = 0
    while (kind := data[position : position + 4]) != b"bvx$":
        (stated,) = struct.unpack_from("<I", data, position + 4)
        if kind == b"bvx2":
            first, second, third = struct.unpack_from("<QQQ", data, position + 8)
            n_matches = first >> 40 & 0xFFFFF
            length = (third & 0xFFFFFFFF) + (first >> 20 & 0xFFFFF) + (second >> 40 & 0xFFFFF)
            if n_matches > MOST_MATCHES or third & 0xFFFFFFFF < 32:
                raise ValueError
            yield _Block(stated, MOST_LITERALS + n_matches * LONGEST_MATCH)
        elif kind == b"bvxn":
            length = 12 + struct.unpack_from("<I", data, position + 8)[0]
            yield _Block(stated, stated)
        elif kind == b"bvx-":
            length = 8 + stated
            yield _Block(stated, stated)
        else:
            raise ValueError
        position += length


def _damaged(where: Path | str, got: str) -> BadData:
    return BadData(where, "content", expected="data compressed by LZFSE", got=got, fix="copy it again from its source.")
