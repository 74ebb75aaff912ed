"""Files from outside: regular ones only, and no more of one than is expected.

A pipe would let its reader wait for ever and a device can do anything when it is read, so neither is touched beyond
being opened. What is judged is what was opened, so nothing can be put in its place in between.
"""

from __future__ import annotations

import codecs
import errno
import functools
import io
import operator
import os
import stat
from pathlib import Path
from typing import Any, TypeVar

from emb_runtime.errors import near

T = TypeVar("T")

_KINDS = (
    (stat.S_ISDIR, "a directory"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)

_WANTED = ("O_RDONLY", "O_CLOEXEC", "O_NONBLOCK", "O_NOCTTY", "O_BINARY", "O_NOINHERIT")
_FLAGS = functools.reduce(operator.or_, (getattr(os, name, 0) for name in _WANTED))
"""Those of the flags that this operating system has. Not to wait: a pipe opens when somebody writes to it."""


class _Regular(io.FileIO):
    """A file of which each read gives bytes or raises OSError: some files of the kernel have none yet."""

    def readinto(self, buffer: Any) -> int:
        """Read into a buffer; gives the number of bytes."""
        count: int | None = super().readinto(buffer)
        return _there(count)

    def readall(self) -> bytes:
        """Read the rest."""
        return _there(super().readall())


def _there(found: T | None) -> T:
    if found is None:
        raise OSError(errno.EAGAIN, "expected a regular file, and its content has to be waited for")
    return found


def open_regular(path: str | Path) -> io.BufferedReader:
    """A regular file, open for reading; raises OSError for anything else."""
    try:
        return io.BufferedReader(_Regular(path, "rb", opener=_opened))
    except FileNotFoundError as err:
        raise FileNotFoundError(err.errno, f"{err.strerror}{near_file(Path(path))}", str(path)) from err
    except ValueError as err:  # a zero byte in the name
        raise OSError(errno.EINVAL, "no file can have that name", str(path)) from err


def near_file(path: Path) -> str:
    """The file, or the folder of a path, that may have been meant, see :func:`emb_runtime.errors.near`."""
    try:
        others = sorted(other for other in path.parent.iterdir() if other.name != path.name)  # one may lead nowhere
    except OSError:
        return "" if path.parent == path else near_file(path.parent)
    ending = path.suffix.casefold()
    alike = [other for other in others if other.suffix.casefold() == ending or other.stem == path.stem]
    return near(path.stem, [other.stem for other in alike], {other.stem: str(other) for other in alike})


def _opened(path: str, _flags: int) -> int:
    fd = os.open(path, _FLAGS)
    mode = os.fstat(fd).st_mode
    if not stat.S_ISREG(mode):
        os.close(fd)
        kind = next((name for test, name in _KINDS if test(mode)), "something else")
        raise OSError(errno.EINVAL, f"expected a regular file, and it is {kind}", str(path))
    return fd


def read_bytes(path: str | Path, most: int) -> bytes:
    """Content of a regular file of at most so many bytes; raises OSError for anything else."""
    with open_regular(path) as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise OSError(errno.EFBIG, f"expected at most {most} bytes, and it has more", str(path))
    return data


def read_text(path: str | Path, most: int) -> str:
    """Text of a regular file in UTF-8, with a mark or without; see :func:`read_bytes`."""
    return read_bytes(path, most).decode("utf-8-sig")


def decode(data: bytes, encoding: str = "") -> str:
    """Text of a tool that does not say its encoding: by its mark, else in UTF-8, else in cp1252, that of Windows.

    UnicodeDecodeError if it is in none of them, or not in the ``encoding`` that is given.
    """
    if encoding:
        return data.decode(encoding).removeprefix("\ufeff")
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252")
