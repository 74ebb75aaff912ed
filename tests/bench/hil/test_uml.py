"""Each kernel has a processor of its own, as long as there are enough."""

from __future__ import annotations

import os
from contextlib import ExitStack
from pathlib import Path

import pytest

from emb_bench.hil import uml


@pytest.fixture(autouse=True)
def _cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def test_two_kernels_share_no_processor_and_a_further_one_is_not_pinned() -> None:
    allowed = os.sched_getaffinity(0)
    with ExitStack() as stack:
        taken = []
        for _ in allowed:
            taken.append(stack.enter_context(uml.own_processor()))
            assert os.sched_getaffinity(0) == {taken[-1]}
            os.sched_setaffinity(0, allowed)  # the next one is another process
        assert set(taken) == allowed
        assert stack.enter_context(uml.own_processor()) is None
        assert os.sched_getaffinity(0) == allowed


def test_afterwards_the_process_is_where_it_was_and_the_processor_is_free() -> None:
    before = os.sched_getaffinity(0)
    with uml.own_processor() as first:
        pass
    assert os.sched_getaffinity(0) == before
    with uml.own_processor() as again:
        assert again == first


def test_where_nothing_can_be_locked_nothing_is_pinned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    before = os.sched_getaffinity(0)
    with uml.own_processor() as processor:
        assert processor is None
        assert os.sched_getaffinity(0) == before
