"""Decompressed chunks of a bag in a temporary file: bz2 takes longer than all else, and bags are read twice."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path
from typing import IO

SPOOL_FOLDER = "/var/tmp"
"""Where the file is, if this exists, and else in Python's folder for such files: /tmp may be in memory."""

FREE_SHARE = 0.5
"""Share of the free space there that is used at most; further chunks are decompressed again. Chosen, sensitivity not
measured."""


class Spool:
    """Bytes by key, in a file without a name, which ends with the process."""

    def __init__(self) -> None:
        self._file: IO[bytes] | None = None
        self._places: dict[int, tuple[int, int]] = {}
        self._end, self._most = 0, 1

    def put(self, key: int, data: bytes) -> None:
        """Keep the bytes, if there is room."""
        if key in self._places or self._end >= self._most:
            return
        try:
            if self._file is None:
                folder = SPOOL_FOLDER if Path(SPOOL_FOLDER).is_dir() else tempfile.gettempdir()
                self._most = int(shutil.disk_usage(folder).free * FREE_SHARE)
                self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115
            if self._end + len(data) > self._most:
                return
            self._file.seek(self._end)
            self._file.write(data)
            self._file.flush()
        except OSError:  # A full or read-only disc makes reading slow, not impossible.
            self._most = 0
            return
        self._places[key] = (self._end, len(data))
        self._end += len(data)

    def get(self, key: int) -> bytes | None:
        """The bytes that were kept, or None."""
        if self._file is None or key not in self._places:
            return None
        begin, size = self._places[key]
        data = os.pread(self._file.fileno(), size, begin)
        return data if len(data) == size else None
