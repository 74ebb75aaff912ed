"""Only regular files of a bounded size are read; whatever else has the name is refused at once."""

from __future__ import annotations

import os
import socket
import stat
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

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


def test_what_was_opened_is_judged_and_read_whatever_has_its_name_now(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, plain = tmp_path / "given", os.open

    def replaced(name: str, flags: int) -> int:
        opened = plain(name, flags)
        path.unlink()
        then(path)
        return opened

    monkeypatch.setattr(os, "open", replaced)
    path.write_bytes(b"what was there")
    then: Callable[[Path], object] = os.mkfifo
    assert read_bytes(path, 20) == b"what was there"
    then = partial(Path.write_bytes, data=b"what is there")  # In the place of the pipe
    with pytest.raises(OSError, match="expected a regular file, and it is a pipe"):
        read_bytes(path, 20)


def test_what_has_to_be_waited_for_is_an_error_and_not_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pipe = tmp_path / "pipe"  # as /proc/kmsg, which says that it is a regular file
    os.mkfifo(pipe)
    monkeypatch.setattr(stat, "S_ISREG", lambda _mode: True)
    with open_regular(pipe) as file, pipe.open("wb"):
        for read in (file.read, file.read1, lambda: file.read(5), lambda: file.readinto(bytearray(5))):
            with pytest.raises(OSError, match="expected a regular file, and its content has to be waited for"):
                read()


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
