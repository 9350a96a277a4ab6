from __future__ import annotations

import numba
import numpy as np
import pytest

from bask_data.core.compiled import compiled


def total(values):
    result = 0.0
    for value in values:
        result += value
    return result


def test_compiled_code_answers_as_python_does() -> None:
    values = np.arange(5.0)
    assert compiled(total)(values) == total(values)


def test_where_nothing_can_be_kept_it_is_compiled_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.core.caching.CompileResultCacheImpl, "_locator_classes", [])
    with pytest.raises(RuntimeError, match="no locator available"):
        numba.njit(cache=True)(total)
    assert compiled(total)(np.arange(5.0)) == 10.0
