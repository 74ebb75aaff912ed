"""Plays faults against emb-run and emb-node, inside the kernel that has the buses, and keeps every frame.

    python -m tests.hil.stage PLAN.json OUT_DIR

PLAN is a list of plays, see :func:`tests.hil.plays.plan`. For each it writes OUT_DIR/NAME.json: exit codes, outputs,
when each action was done, and all frames on the node's bus, and on the run's if it is another, as
[time, identifier, data in hex].

Both programs are forked from this process, which has imported them before: in a slow kernel their imports would take
longer than all plays together.
"""

from __future__ import annotations

import contextlib
import io
import json
import multiprocessing
import os
import shutil
import signal
import socket
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cantools

import emb_bench.cli.node
import emb_runtime.cli.gateway
import emb_runtime.cli.main
import emb_runtime.safety.watchdog_process  # its bytecode and what it imports are then in the page cache
import simulated_drives
from emb_runtime.can.messages import load_layout
from emb_runtime.records import Frame
from tests.drives import EXAMPLES
from tests.hil import bus_faults, link
from tests.hil.failing_policy import make_it_hang
from tests.hil.sniffer import FRAME, open_socket, read, wait_until

LAYOUT = load_layout()
COMMAND, VELOCITY = LAYOUT.command.identifier, LAYOUT.velocity.identifier
PATIENCE = 120.0  # For anything that must come [s]
BABBLER = 97  # Real-time priority, above the node's: other nodes on a bus ask nobody
ROLES = {"recorder": "emb_runtime.log.recorder_process", "watchdog": "emb_runtime.safety.watchdog_process"}


class Child:
    """A program of ours as a fork of this process; its output goes into files."""

    def __init__(self, main: Callable[[list[str]], int], argv: list[str], folder: Path, name: str) -> None:
        self.out, self.err = (folder / f"{name}.{stream}" for stream in ("out", "err"))
        self.process = multiprocessing.get_context("fork").Process(target=self._become, args=(main, argv))
        self.process.start()
        assert self.process.pid is not None
        self.pid = self.process.pid

    def _become(self, main: Callable[[list[str]], int], argv: list[str]) -> None:
        for number, path in ((1, self.out), (2, self.err)):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), number)
        sys.stdout, sys.stderr = (io.TextIOWrapper(os.fdopen(n, "wb", buffering=0), "utf-8") for n in (1, 2))
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.argv = ["emb", *argv]
        sys.exit(main(argv))

    @property
    def exit(self) -> int | None:
        """Its exit code, that of a signal negative; None as long as it runs."""
        return self.process.exitcode

    def running(self) -> bool:
        """Whether it has not ended."""
        return self.process.exitcode is None

    def end(self) -> dict[str, Any]:
        """Wait for it, and by force if it takes too long; what it said."""
        forced = not wait_until(lambda: not self.running(), PATIENCE)
        if forced:
            os.kill(self.pid, signal.SIGKILL)
            wait_until(lambda: not self.running(), PATIENCE)
        said = {"out": self.out.read_text(errors="replace"), "err": self.err.read_text(errors="replace")}
        return {"exit": self.exit, "forced": forced, **said}


def descendant(pid: int, module: str) -> int | None:
    """The process that a run has started for one of its parts."""
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            parent = int(stat.read_text().rpartition(")")[2].split()[1])
            if parent == pid and module in stat.with_name("cmdline").read_text():
                return int(stat.parent.name)
    return None


def left() -> list[str]:
    """Parts of a run that have not ended."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            words = entry.read_text().split("\0")  # an ended one has none
            found += [module for module in ROLES.values() if module in words]
    return found


def is_enabled(data: bytes) -> bool:
    """Returns True if our command enables the brake's current."""
    return bool(data[4] & 1)


def drive_command(drive: str) -> tuple[int, Callable[[bytes], bool]]:
    """Identifier of a drive's command on the bus, and whether one says another current than 0 A."""
    command = tomllib.loads((EXAMPLES / f"{drive}.toml").read_text())["can"]["signals"]["command"]
    name, signal_name = command["signal"].split(".")
    database = cantools.database.load_file(EXAMPLES / f"{drive}.dbc")
    assert isinstance(database, cantools.database.Database)
    message = database.get_message_by_name(name)
    least = 0.01 * command["range"][1]

    def moves(data: bytes) -> bool:
        values = message.decode(data)
        assert isinstance(values, dict)
        return bool(abs(float(values[signal_name])) > least)  # type: ignore[arg-type]

    return message.frame_id | (socket.CAN_EFF_FLAG if message.is_extended_frame else 0), moves


class Stage:
    """The buses and programs of one play."""

    def __init__(self, play: dict[str, Any], folder: Path) -> None:
        self.play = play
        self.folder = folder
        self.bus = play["node_bus"]
        self.command, self.is_enabled = drive_command(play["drive"]) if play["drive"] else (COMMAND, is_enabled)
        self.commands = open_socket([self.command], self.bus)
        self.enabled = self.disabled = 0
        self.node: Child | None = None
        self.gateway: Child | None = None
        self.run: Child | None = None
        self.nodes: list[dict[str, Any]] = []
        self.done: list[tuple[str, int]] = []
        self.routes: list[bus_faults.Route] = []
        self.victims: dict[str, int] = {}

    def start_node(self) -> None:
        """Start the node, and wait until it says that it is on the bus."""
        program = simulated_drives.main if self.play["drive"] else emb_bench.cli.node.main
        node = Child(program, self.play["node"], self.folder, "node")
        self.node = node
        assert wait_until(lambda: node.err.exists() and b"\n" in node.err.read_bytes(), PATIENCE), "no node"
        if self.play["gateway"]:
            gateway = Child(emb_runtime.cli.gateway.main, self.play["gateway"], self.folder, "gateway")
            self.gateway = gateway
            assert wait_until(lambda: gateway.err.exists() and b": armed, " in gateway.err.read_bytes(), PATIENCE), (
                "no gateway"
            )

    def start_run(self) -> None:
        """Start the run."""

        def main(argv: list[str]) -> int:
            if self.play["policy"] not in ("", "giant"):
                make_it_hang(self.play["policy"])
            return emb_runtime.cli.main.main(argv)

        self.run = Child(main, self.play["run"], self.folder, "run")

    def await_commands(self, count: int, stops: int) -> bool:
        """Wait until so many enabled commands were on the bus since the last action, and stop frames at all."""
        target = self.enabled + count

        def seen() -> bool:
            for _, _, data in read(self.commands)[0]:
                enabled = self.is_enabled(bytes.fromhex(data))
                self.enabled += enabled
                self.disabled += not enabled
            return self.enabled >= target and self.disabled >= stops

        return wait_until(lambda: seen() or not self.run_is_on(), PATIENCE) and seen()

    def run_is_on(self) -> bool:
        return self.run is not None and self.run.running()

    def act(self, action: dict[str, Any]) -> None:
        """Do one thing."""
        if not self.await_commands(action.get("after", 0), action.get("stops", 0)):
            raise RuntimeError(f"the run sent too few commands before: {action}")
        time.sleep(action.get("pause", 0.0))
        if "to" in action:  # looked for before the clock is read: it takes its time
            self.victims[action["to"]] = self.victims.get(action["to"]) or self.find(action["to"])
        self.done.append((action["do"], time.time_ns()))
        getattr(self, f"do_{action['do']}")(action)

    def find(self, role: str) -> int:
        """The process id of a part that runs."""
        assert self.run is not None
        programs = {"run": self.run, "node": self.node, "gateway": self.gateway}
        pid = child.pid if (child := programs.get(role)) else None
        found = pid if pid is not None else descendant(self.run.pid, ROLES[role])
        assert found is not None, f"there is no {role}"
        return found

    def do_signal(self, action: dict[str, Any]) -> None:
        os.kill(self.victims[action["to"]], getattr(signal, action["signal"]))

    def do_kill(self, action: dict[str, Any]) -> None:
        """Kill several processes before any of them sees another go."""
        victims = [self.find(role) for role in action["roles"]]
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(98))
        for pid in victims:
            os.kill(pid, signal.SIGKILL)
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))

    def do_restart_node(self, _action: dict[str, Any]) -> None:
        assert self.node is not None
        self.nodes.append(self.node.end())
        self.start_node()

    def do_command(self, _action: dict[str, Any]) -> None:
        """A stranger's command, valid in all and in answer to the newest sample."""
        with open_socket([VELOCITY, COMMAND], self.bus) as ear:
            counter = 0
            sample = None
            while sample is None:
                for _, identifier, data in read(ear)[0]:
                    if identifier == COMMAND:
                        counter = (int(data[2:4], 16) & 0x0F) + 1
                    else:
                        sample = int(data[2:4], 16) & 0x0F
                time.sleep(0.0002)
            foreign = LAYOUT.encode_command(counter % 15, sample, 3.0, True)
            self._send(foreign)

    def do_babble(self, action: dict[str, Any]) -> None:
        """A stranger that fills the bus: eight frames per millisecond, whoever else needs the processor."""
        raw = FRAME.pack(action["identifier"], 8, bytes.fromhex(action["data"]))
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(BABBLER))
        try:
            with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as mouth:
                mouth.bind((self.bus,))
                for _ in range(round(action["seconds"] * 2000)):
                    for _ in range(4):
                        with contextlib.suppress(OSError):  # no room: the next one
                            mouth.send(raw)
                    time.sleep(0.0005)
        finally:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))

    def _send(self, frame: Frame) -> None:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as mouth:
            mouth.bind((self.bus,))
            mouth.send(FRAME.pack(frame.identifier, len(frame.data), frame.data))

    def do_link(self, action: dict[str, Any]) -> None:
        link.set_up(action["interface"], action["up"])

    def do_impair(self, action: dict[str, Any]) -> None:
        bus_faults.impair(action["interface"], bus_faults.Impairment(**action["by"]))

    def do_clear_netem(self, action: dict[str, Any]) -> None:
        bus_faults.clear_netem(action["interface"])

    def do_corrupt(self, action: dict[str, Any]) -> None:
        """Join the two buses, with one message corrupted on the way; with nothing to lay over it, whole."""
        for route in self.routes:
            bus_faults.remove_route(route)
        self.routes = bus_faults.bridge(
            self.bus, self.play["run_bus"], action["identifier"], bytes.fromhex(action.get("xor", ""))
        )

    def do_bus_off(self, action: dict[str, Any]) -> None:
        bus_faults.report_bus_off(self.bus, action["off"])

    def do_step_clock(self, action: dict[str, Any]) -> None:
        bus_faults.step_clock(action["seconds"])

    def do_small_disk(self, action: dict[str, Any]) -> None:
        bus_faults.small_disk(Path(action["where"]), action["size"])

    def do_fill(self, action: dict[str, Any]) -> None:
        """Take all the room that a small disk has left."""
        room = os.statvfs(action["where"])
        with Path(action["where"], "filler").open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, room.f_bavail * room.f_frsize)

    def clean_up(self) -> None:
        """Leave the buses as they were."""
        for route in self.routes:
            bus_faults.remove_route(route)
        for interface in {self.bus, self.play["run_bus"]}:
            with contextlib.suppress(OSError):
                bus_faults.clear_netem(interface)
            link.set_up(interface)
        self.commands.close()


@contextlib.contextmanager
def stage(play: dict[str, Any], folder: Path) -> Iterator[Stage]:
    made = Stage(play, folder)
    try:
        yield made
    finally:
        for child in (made.run, made.gateway, made.node):
            if child is not None and child.running():
                os.kill(child.pid, signal.SIGKILL)
                wait_until(lambda child=child: not child.running(), PATIENCE)
        made.clean_up()


def perform(play: dict[str, Any], out: Path) -> dict[str, Any]:
    """Play one fault; what was seen."""
    folder = Path("/dev/shm") / play["name"]
    folder.mkdir()
    report: dict[str, Any] = {"name": play["name"]}
    with stage(play, folder) as on, open_socket([], on.bus) as everything, open_socket([], play["run_bus"]) as there:
        try:
            for action in play["before"]:
                on.act(action)
            on.done.clear()
            on.start_node()
            on.start_run()
            for action in play["actions"]:
                on.act(action)
        except (AssertionError, OSError, RuntimeError) as err:
            report["error"] = repr(err)
        assert on.run is not None or "error" in report
        report["run"] = on.run.end() if on.run else None
        time.sleep(play["linger"])
        for child, kept in ((on.gateway, report.setdefault("gateways", [])), (on.node, on.nodes)):
            if child is not None:
                with contextlib.suppress(ProcessLookupError):
                    if child.running():
                        os.kill(child.pid, signal.SIGTERM)
                kept.append(child.end())
        wait_until(lambda: not left(), 10.0)
        report |= {"nodes": on.nodes, "done": on.done, "left": left()}
        report["frames"], report["dropped"] = read(everything)
        if play["run_bus"] != on.bus:
            report["run_frames"], dropped = read(there)
            report["dropped"] += dropped
    # Written in memory first: a write to the host's files holds up the whole kernel.
    log = Path(play["log"])
    if log.exists():
        shutil.copyfile(log, out / f"{play['name']}.mcap")
    shutil.rmtree(folder, ignore_errors=True)
    return report


def main() -> None:
    """Play the plan."""
    plan, out = json.loads(Path(sys.argv[1]).read_text()), Path(sys.argv[2])
    for play in plan:
        began = time.time()
        report = perform(play, out)
        (out / f"{play['name']}.json").write_text(json.dumps(report))
        sys.stderr.write(f"{play['name']}: {time.time() - began:.1f} s {report.get('error', '')}\n")
        sys.stderr.flush()


if __name__ == "__main__":
    main()
