"""Files that stay whole on a full disk: a change is made completely, or not at all."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

#: Offset in a file and the bytes to be there.
Part = tuple[int, bytes]


def replace_file(path: Path, data: bytes) -> None:
    """Make a file, and its folder if missing, or replace it; if that fails, the old one remains.

    Raises:
        OSError: It cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f"{path.name}.part")
    try:
        draft.write_bytes(data)
        draft.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            draft.unlink(missing_ok=True)
        raise


def extend_file(path: Path, data: bytes) -> None:
    """Add bytes at the end of an existing file; if that fails, it is as before.

    Raises:
        OSError: It cannot be written.
    """
    amend_file(path, [(os.path.getsize(path), data)])


def amend_file(path: Path, parts: Sequence[Part]) -> None:
    """Change an existing file in places; if that fails, it is as before.

    What makes it longer comes first: the rest needs no space.

    Args:
        path: The file.
        parts: What to write, each over what is there or beyond the end; without overlap, or in
            order.

    Raises:
        OSError: It cannot be written.
    """
    size = os.path.getsize(path)
    longer = [part for part in parts if part[0] + len(part[1]) > size]
    within = [part for part in parts if part[0] + len(part[1]) <= size]
    old = []
    with open(path, "rb") as file:
        for offset, data in parts:
            file.seek(offset)
            old.append((offset, file.read(len(data))))
    try:
        # Twice, as some network file systems find out when a file is closed that a disk is full.
        for group in filter(None, (longer, within)):
            _put(path, group)
    except OSError:
        with contextlib.suppress(OSError):
            os.truncate(path, size)
            _put(path, old)
        raise


def _put(path: Path, parts: Sequence[Part]) -> None:
    with open(path, "r+b", buffering=0) as file:
        for offset, data in parts:
            file.seek(offset)
            while data:
                data = data[file.write(data) :]


class Draft(io.RawIOBase):
    """An existing file as it is to be: what is written stays in memory, see `parts`.

    HDF5 writes into this: after an error of writing the library crashes when it closes the file.
    """

    def __init__(self, old: io.BufferedReader) -> None:
        self._old = old
        self._size = old.seek(0, os.SEEK_END)
        self._within: list[Part] = []
        self._beyond = bytearray()
        self._at = 0

    @property
    def parts(self) -> list[Part]:
        """What is new, for `amend_file`."""
        return [(self._size, bytes(self._beyond)), *self._within]

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        """Go to an offset from the start, the present place or the end."""
        end = self._size + len(self._beyond)
        self._at = {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: end}[whence] + offset
        return self._at

    def readinto(self, buffer: Any, /) -> int:
        """Fill a buffer, with zeros beyond the end."""
        out = memoryview(buffer).cast("B")
        start, size = self._at, len(out)
        self._old.seek(start)
        data = bytearray(self._old.read(max(0, min(size, self._size - start))).ljust(size, b"\0"))
        for offset, part in self.parts:
            low, high = max(start, offset), min(start + size, offset + len(part))
            if low < high:
                data[low - start : high - start] = part[low - offset : high - offset]
        out[:] = data
        self._at += size
        return size

    def write(self, data: Any, /) -> int:
        """Keep bytes that are to be written."""
        new = bytes(data)
        inside = max(0, min(len(new), self._size - self._at))
        if inside:
            self._within.append((self._at, new[:inside]))
        if inside < len(new):
            start = max(0, self._at - self._size)
            self._beyond.extend(bytes(max(0, start - len(self._beyond))))
            self._beyond[start : start + len(new) - inside] = new[inside:]
        self._at += len(new)
        return len(new)

    def truncate(self, size: int | None = None, /) -> int:
        """End the file here, but not within what is on disk, which HDF5 does without."""
        size = self._at if size is None else size
        beyond = max(0, size - self._size)
        del self._beyond[beyond:]
        self._beyond.extend(bytes(beyond - len(self._beyond)))
        return size

    def close(self) -> None:
        """Close the file that is read."""
        self._old.close()
        super().close()
