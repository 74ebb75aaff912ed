"""Commissions a brake on vcan0, inside the kernel that has it, as a person at a terminal would.

    python -m tests.hil.terminal SCENES.json FOLDER

SCENES is a list of {"name", "node": [...] or null, "gateway": [...], "run": [...], "answers": [...], "interrupt": n}:
the node is started anew, unless it is null, and a gateway where there is one; the questions are answered by the answers
in turn, those that are left by "y"; after the n-th answer Ctrl-C is pressed as soon as something is on the bus.
FOLDER/played.json has for each scene what was printed, the exit code, and for each question how many command frames
were on the bus when it came, and when it was answered.
"""

from __future__ import annotations

import json
import os
import pty
import select
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from tests.hil.sniffer import COMMAND, open_socket, read

QUESTION = b"Arm now?"
PAUSE = 0.3  # Time that a question stays unanswered, in which nothing may leave [s]


class Scene:
    """One call of emb-commission with a terminal."""

    def __init__(self, scene: dict[str, Any], commands: Any) -> None:
        self.answers: list[str] = list(scene.get("answers", ()))
        self.interrupt = scene.get("interrupt", 0)
        self.commands, self.sent, self.out = commands, 0, b""
        self.questions: list[tuple[int, int]] = []
        self.process, self.terminal = pty.fork()
        if self.process == 0:
            os.execv(sys.executable, [sys.executable, "-m", "emb_bench.cli.commission", *scene["run"]])

    def count(self) -> int:
        """Command frames on the bus so far."""
        self.sent += len(read(self.commands)[0])
        return self.sent

    def play(self) -> dict[str, Any]:
        """Answer until it ends."""
        while self.heard():
            if self.out.count(QUESTION) == len(self.questions):
                continue
            before = self.count()
            time.sleep(PAUSE)
            self.questions.append((before, self.count()))
            os.write(self.terminal, (self.answers.pop(0) if self.answers else "y\n").encode())
            if len(self.questions) == self.interrupt:
                while self.count() == before:
                    time.sleep(0.001)
                os.write(self.terminal, b"\x03")
        code = os.waitstatus_to_exitcode(os.waitpid(self.process, 0)[1])
        os.close(self.terminal)
        return {"exit": code, "out": self.out.decode(), "questions": self.questions, "sent": self.count()}

    def heard(self) -> bool:
        """Take what it prints; False once it has ended."""
        while select.select([self.terminal], [], [], 0.05)[0]:
            try:
                text = os.read(self.terminal, 65536)
            except OSError:  # so a terminal ends
                return False
            if not text:
                return False
            self.out += text
            if self.out.count(QUESTION) > len(self.questions):
                return True
        return True


def ended(node: subprocess.Popen[bytes]) -> dict[str, Any]:
    """End a node; its own account."""
    node.send_signal(signal.SIGTERM)
    account: dict[str, Any] = json.loads(node.communicate()[0])
    return account


def main() -> None:
    """Play all scenes."""
    scenes, folder = json.loads(Path(sys.argv[1]).read_text()), Path(sys.argv[2])
    node: subprocess.Popen[bytes] | None = None
    gateway: subprocess.Popen[bytes] | None = None
    played: dict[str, Any] = {"nodes": []}
    for scene in scenes:
        if scene["node"] is not None:
            if node is not None:
                played["nodes"].append(ended(node))
            node = subprocess.Popen([sys.executable, "-m", *scene["node"]], stdout=subprocess.PIPE)
        if "gateway" in scene:
            if gateway is not None:
                ended(gateway)
            gateway = subprocess.Popen(
                [sys.executable, "-m", *scene["gateway"]], stdout=subprocess.PIPE, stderr=subprocess.PIPE
            )
            assert gateway.stderr is not None
            while b": armed, node on" not in (line := gateway.stderr.readline()):
                assert line, "the gateway has ended"
        commands = open_socket([COMMAND])
        played[scene["name"]] = Scene(scene, commands).play()
        commands.close()
    if gateway is not None:
        played["gateway"] = ended(gateway)
    if node is not None:
        played["nodes"].append(ended(node))
    (folder / "played.json").write_text(json.dumps(played))


if __name__ == "__main__":
    main()
