"""emb-hil: Ctrl-C while a kernel is made ready, and a processor of its own for each kernel, where that goes."""

from __future__ import annotations

import os
import signal
from contextlib import ExitStack
from pathlib import Path

import pytest

from emb_bench.hil import uml
from emb_bench.hil.cli import main
from emb_runtime.errors import EXIT_BUS


def test_ctrl_c_while_a_kernel_is_made_ready_ends_it_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def made(_state: Path, _memory: int, _slow: int) -> dict[str, str]:
        signal.raise_signal(signal.SIGINT)  # to compile its library takes seconds
        return dict(os.environ)

    (tmp_path / "sleep").write_text("#!/bin/sh\nexec sleep 1000\n")
    (tmp_path / "sleep").chmod(0o755)
    monkeypatch.setenv("TMPDIR", str(tmp_path / "state"))
    monkeypatch.setattr("tempfile.tempdir", None)
    (tmp_path / "state").mkdir()
    monkeypatch.setattr(uml, "_program", lambda: str(tmp_path / "sleep"))
    monkeypatch.setattr(uml, "_environment", made)
    assert main(["--uml", "--", "true"]) == 130
    assert capfd.readouterr() == ("", "")
    assert list((tmp_path / "state").iterdir()) == []


def test_what_is_not_installed_is_named_with_its_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / uml.PROGRAM).touch(mode=0o755)
    monkeypatch.setattr(uml, "IP", str(tmp_path / "ip"))
    for path, package in (("", uml.PACKAGE), (str(tmp_path), "iproute2")):
        monkeypatch.setenv("PATH", path)
        assert main(["--uml", "--", "true"]) == EXIT_BUS
        assert f"apt-get install {package}`" in capfd.readouterr().err


def test_two_kernels_share_no_processor_and_a_further_one_is_not_pinned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    allowed = os.sched_getaffinity(0)
    for _ in range(2):  # afterwards every processor is free again
        with ExitStack() as stack:
            taken = []
            for _ in allowed:
                taken.append(stack.enter_context(uml.own_processor()))
                assert os.sched_getaffinity(0) == {taken[-1]}
                os.sched_setaffinity(0, allowed)  # the next one is another process
            assert set(taken) == allowed
            assert stack.enter_context(uml.own_processor()) is None
            assert os.sched_getaffinity(0) == allowed
    with uml.own_processor():
        pass
    assert os.sched_getaffinity(0) == allowed
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with uml.own_processor() as processor:  # where nothing can be locked
        assert processor is None
        assert os.sched_getaffinity(0) == allowed
