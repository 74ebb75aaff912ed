"""Only regular files of a bounded size are read; whatever else has the name is refused at once."""

from __future__ import annotations

import contextlib
import os
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from emb_runtime.system import input_file
from emb_runtime.system.input_file import open_regular, read_bytes, read_text


def open_files() -> set[str]:
    return {each.name for each in Path("/proc/self/fd").iterdir()}


def listen(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as bound:
        bound.bind(str(path))


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (os.mkfifo, "expected a regular file, and it is a pipe"),
        (Path.mkdir, "expected a regular file, and it is a directory"),
        (listen, "No such device or address"),
        (lambda path: path.symlink_to("/dev/zero"), "expected a regular file, and it is a device"),
        (lambda path: path.symlink_to(path), "Too many levels of symbolic links"),
        (lambda _: None, "No such file or directory"),
    ],
)
def test_what_is_no_regular_file_is_refused_and_nobody_waits_for_it(
    tmp_path: Path, make: Callable[[Path], None], said: str
) -> None:
    path = tmp_path / "given"
    make(path)
    before = open_files()
    with pytest.raises(OSError, match=said):
        open_regular(path)
    assert open_files() == before


def test_a_name_that_no_file_can_have_is_refused_alike() -> None:
    with pytest.raises(OSError, match="no file can have that name"):
        open_regular("a\0b")


def test_a_file_is_read_up_to_its_bound_and_no_further(tmp_path: Path) -> None:
    path = tmp_path / "given"
    path.write_bytes("grün".encode())
    assert read_bytes(path, 5) == "grün".encode()
    assert read_text(path, 5) == "grün"
    with pytest.raises(OSError, match="expected at most 4 bytes, and it has more"):
        read_bytes(path, 4)
    with path.open("wb") as file:
        file.truncate(1 << 40)  # sparse
    with pytest.raises(OSError, match="expected at most 4096 bytes"):
        read_bytes(path, 4096)


def test_a_link_to_a_regular_file_is_followed(tmp_path: Path) -> None:
    (tmp_path / "real").write_bytes(b"x")
    (tmp_path / "link").symlink_to("real")
    assert read_bytes(tmp_path / "link", 1) == b"x"


@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")  # the interpreter closes it
def test_an_interruption_at_whatever_step_stays_one(tmp_path: Path) -> None:
    """It is no error of a file descriptor that was closed twice, for which the file would be blamed."""
    path = tmp_path / "given"
    path.write_bytes(b"there")
    left = 1

    def interrupt(frame: FrameType, event: str, _value: object) -> Any:
        nonlocal left
        frame.f_trace_opcodes = frame.f_globals["__name__"] in (input_file.__name__, "os")
        if event == "opcode":
            left -= 1
            if left == 0:
                raise KeyboardInterrupt
        return interrupt

    for step in range(1, 1000):
        before, left = sys.gettrace(), step
        try:
            sys.settrace(interrupt)
            with contextlib.suppress(KeyboardInterrupt):
                assert read_bytes(path, 10) == b"there"
        finally:
            sys.settrace(before)
        if left > 0:
            break
    assert 50 < step < 999
