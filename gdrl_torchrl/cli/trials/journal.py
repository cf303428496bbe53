"""The journal of a search: a line for whatever happens, of many processes."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Generator
from pathlib import Path
from typing import Any, BinaryIO

from optuna.storages.journal import JournalFileBackend, JournalFileSymlinkLock

from gdrl_torchrl.files.safe_files import open_own

_logger = logging.getLogger(__name__)


class SearchJournal(JournalFileBackend):
    """Optuna's journal; a last line that was cut, by a kill or a full disk, is dropped.

    Optuna would write the next line behind it, and read neither ever again.

    Args:
        path: The file, which is made if there is none.

    Raises:
        OSError: If it is a link, or cannot be opened.
        ValueError: If it is no file.
    """

    def __init__(self, path: Path) -> None:
        os.close(open_own(path, os.O_RDWR | os.O_CREAT))
        self.path = path
        self._own_lock = JournalFileSymlinkLock(str(path))
        super().__init__(str(path), self._own_lock)

    def read_logs(self, log_number_from: int) -> Generator[dict[str, Any], None, None]:
        """What happened from a line on.

        Raises:
            ValueError: If a line cannot be read.
        """
        try:
            yield from super().read_logs(log_number_from)
        except ValueError as error:
            raise ValueError(
                f"{self.path} is damaged: {error}: move it away to begin the search anew; "
                "its runs go on from where they are"
            ) from error

    def append_logs(self, logs: list[dict[str, Any]]) -> None:
        """Write lines, whole or not at all.

        Raises:
            OSError: If they cannot be written, as on a full disk.
        """
        lines = "".join(f"{json.dumps(log, separators=(',', ':'))}\n" for log in logs)
        self._own_lock.acquire()
        try:
            with open(open_own(self.path, os.O_RDWR), "r+b", buffering=0) as file:
                end = self._drop_cut_line(file)
                try:
                    _write_all(file, lines.encode())
                    os.fsync(file.fileno())
                except OSError:
                    file.truncate(end)
                    raise
        finally:
            self._own_lock.release()

    def _drop_cut_line(self, file: BinaryIO) -> int:
        """Leave a file at the end of its last whole line, and say where that is."""
        end = file.seek(0, os.SEEK_END)
        while end:
            start = max(end - _BLOCK, 0)
            file.seek(start)
            whole = start + file.read(end - start).rfind(b"\n") + 1
            if whole > start or not start:
                end = whole
                break
            end = start
        cut = os.fstat(file.fileno()).st_size - end
        if cut:
            _logger.warning("%s: dropped %d bytes of a line that was cut", self.path, cut)
            file.truncate(end)
        file.seek(end)
        return end


_BLOCK = 4096


def _write_all(file: BinaryIO, content: bytes) -> None:
    """Write all of it: a disk that fills up takes a part, and refuses the rest."""
    rest = memoryview(content)
    while rest:
        rest = rest[file.write(rest) :]
