from __future__ import annotations

import struct

import lzfse
import numpy as np
import pytest

from bask_data.errors import BadData
from bask_data.formats.lzfse_data import decode_lzfse, stated_size

RANDOM = np.random.default_rng(0).normal(1, 0.1, (192, 256)).astype("<f4").tobytes()


def decode(data: bytes, n_bytes: int) -> bytes:
    return decode_lzfse("0.depth", data, n_bytes, user="record3d")


@pytest.mark.parametrize(
    "plain", [RANDOM, bytes(100_000), b"ab" * 50, b"a", np.arange(50_000, dtype="<u4").tobytes(), RANDOM[:5000]]
)
def test_data_of_all_kinds_of_blocks_is_decoded(plain: bytes) -> None:
    compressed = lzfse.compress(plain)
    assert stated_size("0.depth", compressed) == len(plain)
    assert decode(compressed, len(plain)) == plain


def test_data_that_is_not_compressed_is_taken_as_it_is() -> None:
    assert decode(RANDOM, len(RANDOM)) == RANDOM


def test_data_of_another_size_is_refused_whether_its_header_says_so_or_lies() -> None:
    compressed = lzfse.compress(bytes(100_000))
    with pytest.raises(BadData, match=r"0\.depth: size: expected 5000 bytes when decoded, got 100000"):
        decode(compressed, 5000)
    lying = compressed[:4] + struct.pack("<I", 5000) + compressed[8:]
    with pytest.raises(BadData, match="size: expected 5000 bytes when decoded, got 100000"):
        decode(lying, 5000)


def test_data_that_could_expand_beyond_the_bound_is_refused_by_its_headers() -> None:
    compressed = lzfse.compress(bytes(2_000_000))
    header = bytearray(compressed)
    (first,) = struct.unpack_from("<Q", header, 8)
    struct.pack_into("<Q", header, 8, first & ~(0xFFFFF << 40) | 10_000 << 40)
    block, end = bytes(header[:-4]), bytes(header[-4:])
    with pytest.raises(BadData, match="size: expected at most 536870912 bytes when decoded, got up to"):
        decode(30 * block + end, 60_000_000)
    with pytest.raises(BadData, match="size: expected at most 536870912 bytes"):
        decode(b"bvxn" + struct.pack("<II", 0xFFFFFFFF, 20) + bytes(20) + b"bvx$", 0xFFFFFFFF)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"bvx$",
        b"bvx2" + bytes(40),
        b"PNG and so on, but not LZFSE",
        lzfse.compress(RANDOM)[:-4],
        lzfse.compress(RANDOM)[:1000],
        b"bvx-" + struct.pack("<I", 0xFFFFFFFF) + bytes(20) + b"bvx$",
        lzfse.compress(RANDOM)[:24] + bytes(20) + lzfse.compress(RANDOM)[44:],
    ],
)
def test_damaged_data_is_refused(data: bytes) -> None:
    with pytest.raises(BadData, match=r"0\.depth: (content: expected data compressed by LZFSE|size: expected)"):
        decode(data, len(RANDOM))
