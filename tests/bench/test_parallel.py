"""Work in processes: what it raises is raised here, and a process that dies costs its own piece."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading

import pytest

from emb_bench.parallel import Lost, shared_out
from emb_runtime.errors import PolicyRefusedError


def squared(number: int) -> int:
    """A piece of work; 7 is refused, and 9 ends its process."""
    if number == 7:
        raise PolicyRefusedError("expected another number than 7")
    if number == 9:
        os.kill(os.getpid(), signal.SIGKILL)
    return number**2


def test_every_piece_has_its_result_and_one_that_ends_its_process_says_how() -> None:
    found = dict(shared_out(squared, [1, 9, 3, 4], jobs=2))
    lost = found.pop(1)
    assert found == {0: 1, 2: 9, 3: 16}
    assert isinstance(lost, Lost)
    assert (lost.how, lost.exit_code) == ("was ended by SIGKILL", -signal.SIGKILL)


def test_what_the_work_raises_is_raised_here_and_ends_the_other_processes() -> None:
    children = multiprocessing.active_children()
    with pytest.raises(PolicyRefusedError, match="expected another number than 7"):
        list(shared_out(squared, [1, 7, 3], jobs=2))
    assert multiprocessing.active_children() == children


def test_no_work_needs_no_process() -> None:
    assert list(shared_out(squared, [], jobs=3)) == []


def test_elsewhere_than_in_the_main_thread_work_is_shared_out_too() -> None:
    found: list[tuple[int, int | Lost]] = []
    thread = threading.Thread(target=lambda: found.extend(shared_out(squared, [2], jobs=1)))
    thread.start()
    thread.join()
    assert found == [(0, 4)]
