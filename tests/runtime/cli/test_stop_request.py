"""The operator's request to stop, while nothing is open yet."""

from __future__ import annotations

import signal
import time
import weakref
from collections.abc import Callable

import pytest

from emb_runtime.cli.main import StopRequest
from emb_runtime.cli.preflight import RefusedError
from emb_runtime.errors import EXIT_SAFETY_STOP


@pytest.fixture(autouse=True)
def _handlers() -> object:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


class Watched:
    """Something whose end is noticed."""


def wherever_it_is() -> None:
    signal.raise_signal(signal.SIGINT)


def in_a_callback_of_the_interpreter() -> None:
    """As the import system has them: what is raised here is dropped."""
    watched = Watched()
    reference = weakref.ref(watched, lambda _: signal.raise_signal(signal.SIGINT))
    del watched
    assert reference() is None


@pytest.mark.parametrize("interrupt", [wherever_it_is, in_a_callback_of_the_interpreter])
def test_a_ctrl_c_ends_what_goes_on_and_nothing_else_is_said(
    interrupt: Callable[[], None], capfd: pytest.CaptureFixture[str]
) -> None:
    alarm = signal.getsignal(signal.SIGALRM)

    def start() -> None:
        with StopRequest().at_once():
            interrupt()
            time.sleep(3600)

    with pytest.raises(RefusedError, match="stopped by the operator before anything was opened") as stopped:
        start()
    assert stopped.value.exit_code == EXIT_SAFETY_STOP
    assert capfd.readouterr() == ("", "")
    assert signal.getsignal(signal.SIGALRM) is alarm


def test_another_exception_of_a_callback_is_reported_as_always(capfd: pytest.CaptureFixture[str]) -> None:
    def failing(_: object) -> None:
        raise ValueError("a callback's own")

    with StopRequest().at_once():
        watched = Watched()
        reference = weakref.ref(watched, failing)
        del watched
    assert reference() is None
    assert "ValueError: a callback's own" in capfd.readouterr().err
