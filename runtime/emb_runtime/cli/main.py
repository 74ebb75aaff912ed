"""``emb-run``: guarded experiments on a bench, logged."""

from __future__ import annotations

import glob
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path

from emb_runtime.can.interfaces import open_transport
from emb_runtime.cli import summary
from emb_runtime.cli.documents import refusal
from emb_runtime.cli.experiment import experiment
from emb_runtime.cli.options import log_folder, log_path, names_a_file, parser, prepare
from emb_runtime.cli.plan import Output, Plan, Stage
from emb_runtime.cli.preflight import Check, RefusedError, table
from emb_runtime.cli.session import Bus, Console, listen_only
from emb_runtime.config.bench import shipped_bench_text
from emb_runtime.config.schemas import schema_file, write_schemas
from emb_runtime.errors import EXIT_DONE, BenchFileError, EmbError, UsageError
from emb_runtime.records import LISTEN_ONLY_LOG
from emb_runtime.system.child_process import HAS_CHILD_PROCESSES, Child
from emb_runtime.system.terminal import (
    StopRequest,
    agreed_to_arm,
    complain,
    is_interactive,
    json_document,
    mention,
    show,
)

LISTEN_NS = 50_000_000  # Time between two looks at the keyboard [ns]
VIEWERS = "emb_runtime.viewers"  # Entry-point group of the modules that show a run: ``live``, and its ``report``
VIEWER_TIMEOUT = 10.0  # Longest wait for the process to be ready [s]


class Operator(Console):
    """Operator: sees the pre-flight, and confirms once before anything is armed."""

    def __init__(self, plan: Plan, stop_requested: StopRequest) -> None:
        self._plan = plan
        self.stop_requested = stop_requested
        self._seen = self._agreed = False

    def show(self, checks: tuple[Check, ...], bus: Bus) -> None:
        """Show the stage, and the checks that are not ok; all of them where the operator is to confirm."""
        output, asks = self._plan.output, self._asks(bus)
        full = not self._seen and (output.verbose or asks)
        silent = output.json and not asks
        if not silent and (full or not all(check.ok for check in checks)):
            mention(table([checks[0], *(check for check in checks[1:] if full or not check.ok)]))
        elif not self._seen and not silent and not output.quiet:
            mention(f"pre-flight: {len(checks)} checks, all ok (-v shows them)")
        self._seen = True

    def may_arm(self, bus: Bus) -> bool:
        """Ask, once for the experiment and its ways home."""
        if not self._agreed:
            self._agreed = not self._asks(bus) or self._ask(bus)
        return self._agreed

    def _asks(self, bus: Bus) -> bool:
        confirm = self._plan.precautions.confirm
        return not bus.in_process and is_interactive() if confirm is None else confirm

    def _ask(self, bus: Bus) -> bool:
        def wait() -> None:
            if bus.simulated:
                time.sleep(LISTEN_NS * 1e-9)
            else:  # what comes meanwhile must not fill the kernel's buffer
                frame = bus.transport.receive(bus.clock.now_ns() + LISTEN_NS)
                if frame is not None:
                    bus.pass_over(frame, self._plan.layout)

        return agreed_to_arm(self.stop_requested, wait)


def main(argv: list[str] | None = None) -> int:
    """Entry point of ``emb-run``: a signal ends it at once until a run begins, and with stop frames from then on."""
    try:
        args = parser().parse_args(argv)
        if args.write_bench is not None:
            return _write_bench(args.write_bench)
        if args.write_schemas is not None:
            return _write_schemas(args.write_schemas)
        plan = prepare(args)
        console = Operator(plan, StopRequest())
        try:
            with log_folder(plan.output.log), live_view(plan, console.stop_requested):
                if plan.stage is Stage.READ_ONLY:
                    return _listen(plan, console)
                return _experiment(plan, console)
        except RefusedError as err:
            if plan.output.json:
                show(json_document(refusal(err, plan.iface)))
            raise
    except EmbError as err:
        return complain("emb-run", err)


@contextmanager
def live_view(plan: Plan, stop_requested: Callable[[], bool]) -> Iterator[None]:
    """While this lasts, another process shows the growing logs of a plan, where ``--live`` asks for that.

    On a terminal the page stays afterwards, until Ctrl-C: a run is over before a browser has been opened.
    """
    output, log = plan.output, plan.output.log
    if output.live is None:
        yield
        return
    if not HAS_CHILD_PROCESSES:
        raise UsageError("--live: needs Linux; emb-replay live shows a run from another terminal")
    module = _viewer("live", "shows a run")
    one = names_a_file(log)
    document = {
        "folder": str(log.parent if one else log),
        "pattern": f"{glob.escape(log.stem)}*{glob.escape(log.suffix)}" if one else "*.mcap",
        "port": output.live,
    }
    try:
        child = Child("live", module, document, VIEWER_TIMEOUT)
    except OSError as err:
        raise UsageError(f"--live: {err}") from err
    try:
        page, addresses = child.ready
        mention(f"live at {addresses}")
        if output.open:
            _open(page)
        yield
        if sys.stdout is not None and sys.stdout.isatty() and not stop_requested():
            mention(f"page stays at {page} until Ctrl-C")
            while child.alive and not stop_requested():
                time.sleep(LISTEN_NS * 1e-9)
    finally:
        child.join()


def _open(page: str) -> None:
    import webbrowser  # only here: it looks for programs

    if not webbrowser.open(page):
        mention(f"--open: no browser is found here; open {page} in one")


def _experiment(plan: Plan, console: Console) -> int:
    output = plan.output
    reporter = None if output.report is None else _reporter(output.report)
    document, exit_code = experiment(plan, log_path(output.log), console)
    text = json_document(document) if output.json else summary.run_text(document, output.verbose)
    show(text.partition("\n")[0] if output.quiet else text)
    if reporter is not None:
        reported = _report(reporter, document["log"], output)
        return exit_code or reported
    return exit_code


def _reporter(page: Path) -> str:
    """Module whose command ``report`` writes a page; looked up before the run."""
    module = _viewer("report", "writes a page")
    if page.suffix not in (".html", ".htm"):
        raise UsageError(f"--report {page}: expected a name that ends in .html or .htm")
    if not page.absolute().parent.is_dir():
        raise UsageError(f"--report: {page.absolute().parent} is no folder")
    if page.is_dir() or not os.access(page.absolute().parent, os.W_OK):
        raise UsageError(f"--report {page}: expected a file that can be written")
    return module


def _viewer(name: str, does: str) -> str:
    """Module behind an entry point of :data:`VIEWERS`."""
    entries = list(metadata.entry_points(group=VIEWERS, name=name))
    if not entries:
        raise UsageError(f"--{name}: no module is installed that {does}; emb_bench has one")
    return entries[0].value


def _report(module: str, log: str, output: Output) -> int:
    """Have a process without the real-time settings of this one estimate, and write the page; its exit code."""
    command = [sys.executable, "-P", "-m", module, "report", log, "--output", str(output.report)]
    return subprocess.run(command, stdout=sys.stderr if output.json else None, check=False).returncode


def _listen(plan: Plan, console: Console) -> int:
    path = log_path(plan.output.log, LISTEN_ONLY_LOG)
    transport, clock = open_transport(plan.iface, plan.bench)
    try:
        document, checks = listen_only(plan, Bus(plan.iface, transport, clock), path, console)
    finally:
        transport.close()
    show(json_document(document) if plan.output.json else summary.listen_text(document, checks))
    exit_code: int = document["exit_code"]
    return exit_code


def _write_bench(path: Path) -> int:
    if path.name == schema_file("bench"):
        raise BenchFileError(f"--write-bench {path}: the schema beside it has this name: choose another name")
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(shipped_bench_text())
        write_schemas(path.parent, "bench")
    except FileExistsError as err:
        there = "it is a folder: name a file in it" if path.is_dir() else "there is one already: choose another name"
        raise BenchFileError(f"--write-bench {path}: {there}") from err
    except OSError as err:
        raise BenchFileError(f"--write-bench {path}: {err.strerror}") from err
    return EXIT_DONE


def _write_schemas(folder: Path) -> int:
    try:
        write_schemas(folder)
    except OSError as err:
        raise UsageError(f"--write-schemas {folder}: expected a folder to write in: {err.strerror}") from err
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
