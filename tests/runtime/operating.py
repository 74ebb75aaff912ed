"""What a test of emb-run sees and touches in the user's place."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import pytest

from emb_bench.logs.log import RunLog, read_log
from emb_bench.sim.node import BrakeNode
from emb_bench.sim.transport import SimTransport, SteppedClock, open_sim
from emb_runtime.can.messages import load_layout
from emb_runtime.cli.main import main
from emb_runtime.config.bench import Bench
from emb_runtime.errors import PolicyRefusedError
from emb_runtime.records import Frame


class Keyboard(Protocol):
    """Types something."""

    def __call__(self, text: str, before: bool = False) -> None:
        """Type it, at the first question, or now: ``before`` there is one, or after it."""


Edited = Callable[[str, str], str]  # Path of the shipped bench file with the second text in place of the first


class Sim:
    """What there is to set and to see of the simulated bus that ``main`` opens; of the last one, if it opens many."""

    def __init__(self) -> None:
        self.angle = 0.0
        """Where a hand has turned the brake before anybody listens [rad]."""
        self.sent: list[Frame] = []
        self.opened: list[str] = []
        """Options of each."""
        self.change: Callable[[Frame], Frame | None] = lambda frame: frame
        """What the bus makes of a frame that is received; None: it is lost."""
        self._when: Callable[[BrakeNode], bool] = lambda _node: False
        self._then: Callable[[BrakeNode], object] = lambda _node: None

    def when(self, condition: Callable[[BrakeNode], bool], action: Callable[[BrakeNode], object]) -> None:
        """Do something once, as soon as the node is so far."""
        self._when, self._then = condition, action

    def open(self, options: str, bench: Bench) -> tuple[SimTransport, SteppedClock]:
        transport, clock = open_sim(options, bench)
        self.opened.append(options)
        self.node = transport.node
        self.node.angle = self.angle
        receive, send = transport.receive, transport.send

        def received(deadline_ns: int) -> Frame | None:
            if self._when(self.node):
                self._when = lambda _node: False
                self._then(self.node)
            frame = receive(deadline_ns)
            return None if frame is None else self.change(frame)

        def sent(frame: Frame) -> None:
            self.sent.append(frame)
            send(frame)

        transport.receive, transport.send = received, sent  # type: ignore[method-assign]
        return transport, clock

    @property
    def currents(self) -> list[float]:
        """All that was commanded [A]."""
        return [load_layout().decode_command(frame).current for frame in self.sent]


class EmbRun:
    """``emb-run`` in this process; each call checks the exit code.

    Args:
        first: arguments of every call, before its own, which come later and so count more.
        capsys: what it prints.
        path: where it logs unless it is told another place.
    """

    def __init__(self, first: tuple[str, ...], capsys: pytest.CaptureFixture[str], path: Path) -> None:
        self._first, self._capsys, self._path = (*first, "--log", str(path)), capsys, path

    def streams(self, *arguments: str, code: int = 0) -> tuple[str, str]:
        """What it prints, and on the error stream."""
        self._capsys.readouterr()
        assert main([*self._first, *arguments]) == code
        return self._capsys.readouterr()

    def text(self, *arguments: str, code: int = 0) -> str:
        """What it prints."""
        return self.streams(*arguments, code=code)[0]

    def document(self, *arguments: str, code: int = 0) -> dict[str, Any]:
        """What it prints with ``--json``."""
        (line,) = self.text(*arguments, "--json", code=code).splitlines()
        return dict(json.loads(line))

    def refused(self, reason: str, *arguments: str, code: int = 2) -> None:
        """It must say no with this reason, in one line."""
        assert_one_line(self.streams(*arguments, code=code), reason)

    def log(self) -> RunLog:
        """What it has logged."""
        return read_log(self._path)


def assert_one_line(streams: tuple[str, str], reason: str) -> None:
    out, err = streams
    assert out == ""
    assert err.startswith("emb-run: ")
    assert err.count("\n") == 1
    assert reason in err


def refusal(action: Callable[[], Any]) -> str:
    """The message of the refusal, which must be one line without control characters."""
    with pytest.raises(PolicyRefusedError) as caught:
        action()
    message = str(caught.value)
    assert message.isprintable(), message
    assert len(message) < 1000
    return message
