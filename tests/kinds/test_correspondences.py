from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from bask_data.errors import BadData
from bask_data.kinds import Correspondences, PairRow

N_MATCHES = (0, 4, 3, 0, 5, 1, 0)
ROW = PairRow(camera_a="wrist", frame_a=0, camera_b="wrist", frame_b=1, n_attempts=9, distance=0.1, angle=0.1)


@pytest.fixture
def stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Correspondences:
    """Pairs with and without matches, two or so in a row group."""
    monkeypatch.setattr("bask_data.kinds.correspondences.ROWS_PER_GROUP", 6)
    rng = np.random.default_rng(0)
    with Correspondences.writer(tmp_path) as writer:
        for n in N_MATCHES:
            uv = {name: rng.random(n, dtype=np.float32) for name in ("u_a", "v_a", "u_b", "v_b")}
            writer.append(ROW, {"instance": np.ones(n, np.uint8), **uv})
    return Correspondences(tmp_path)


def test_matches_of_a_pair_are_those_of_the_whole_table(stored: Correspondences) -> None:
    assert pq.read_metadata(stored.path / "matches.parquet").num_row_groups == 2
    for pair, n in reversed([*enumerate(N_MATCHES)]):
        rows = stored.matches_of_pair(pair)
        assert rows.num_rows == n and rows.equals(stored.matches([pair]))


def test_reading_pair_by_pair_reads_the_table_of_pairs_once(stored: Correspondences, monkeypatch) -> None:
    assert stored.matches_of_pair(1).num_rows == 4
    monkeypatch.setattr(Correspondences, "pairs", lambda self: pytest.fail("read again"))
    assert stored.matches_of_pair(4).num_rows == 5


def replaced(stored: Correspondences, table: pa.Table) -> Correspondences:
    pq.write_table(table, stored.path / "matches.parquet")
    return Correspondences(stored.path)


def test_tables_that_contradict_each_other_are_refused(stored: Correspondences) -> None:
    matches = stored.matches()
    with pytest.raises(BadData, match="matches.parquet: expected 13 rows, got 12"):
        replaced(stored, matches.slice(0, 12)).matches_of_pair(1)
    with pytest.raises(BadData, match="columns: expected .*'u_a'.*, got others"):
        replaced(stored, matches.drop_columns(["u_a"])).matches_of_pair(1)
    with pytest.raises(BadData, match="pair: expected 4 rows of pair 1, got others"):
        replaced(stored, matches.take(list(range(13))[::-1])).matches_of_pair(1)
    (stored.path / "matches.parquet").write_bytes(b"PAR1 and no table")
    with pytest.raises(BadData, match="expected a Parquet table, got "):
        Correspondences(stored.path).matches_of_pair(1)


def test_damage_to_the_rows_is_noticed(stored: Correspondences) -> None:
    assert stored.matches_of_pair(1).num_rows == 4
    file = stored.path / "matches.parquet"
    content = bytearray(file.read_bytes())
    content[4 : len(content) // 3] = bytes(len(content) // 3 - 4)
    file.write_bytes(content)
    with pytest.raises(BadData, match="matches.parquet: expected a Parquet table, got "):
        stored.matches_of_pair(1)
