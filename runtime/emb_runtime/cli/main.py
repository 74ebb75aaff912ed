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
from emb_runtime.cli.experiment import experiment
from emb_runtime.cli.options import Plan, Stage, log_folder, log_path, names_a_file, parser, prepare
from emb_runtime.cli.preflight import CheckResult, RefusedError, Verdict, table
from emb_runtime.cli.session import Bus, Console, listen_only
from emb_runtime.config.bench import shipped_bench_text
from emb_runtime.errors import EXIT_DONE, BenchFileError, EmbError, UsageError
from emb_runtime.records import LISTEN_ONLY_LOG
from emb_runtime.system.child_process import HAS_CHILD_PROCESSES, Child
from emb_runtime.system.terminal import ARM_QUESTION, StopRequest, as_json, complain, confirmed, mention, show

LISTEN_NS = 50_000_000  # Time between two looks at the keyboard [ns]
VIEWERS = "emb_runtime.viewers"  # Entry-point group of the modules that show a run: ``live``, and its ``report``
VIEWER_TIMEOUT = 10.0  # Longest wait for the process to be ready [s]


class Operator(Console):
    """Operator: sees the pre-flight, and is asked once before anything is armed."""

    def __init__(self, plan: Plan, stop_requested: StopRequest) -> None:
        self._plan = plan
        self.stop_requested = stop_requested
        self._seen = self._agreed = False

    def show(self, lines: tuple[CheckResult, ...], bus: Bus) -> None:
        """Show the checks that are not ok, below the stage: it says what they are of. All where they are agreed to."""
        whole = not self._seen and (self._plan.verbose or self._asks(bus))
        shown = [line for line in lines if whole or line.verdict is not Verdict.OK]
        if shown and not whole:
            shown = [lines[0], *(line for line in shown if line is not lines[0])]
        quiet = self._plan.json and not self._asks(bus)
        if shown and not quiet:
            mention(table(shown))
        elif not self._seen and not quiet and not self._plan.quiet:
            mention(f"pre-flight: {len(lines)} checks, all ok (-v shows them)")
        self._seen = True

    def may_arm(self, bus: Bus) -> bool:
        """Ask, once for the experiment and its ways home."""
        if not self._agreed:
            self._agreed = not self._asks(bus) or self._ask(bus)
        return self._agreed

    def _asks(self, bus: Bus) -> bool:
        if self._plan.confirm is None:
            return not bus.in_process and sys.stdin is not None and sys.stdin.isatty()
        return self._plan.confirm

    def _ask(self, bus: Bus) -> bool:
        def wait() -> None:
            if bus.simulated:
                time.sleep(LISTEN_NS * 1e-9)
            else:  # what comes meanwhile must not fill the kernel's buffer
                frame = bus.transport.receive(bus.clock.now_ns() + LISTEN_NS)
                if frame is not None:
                    bus.pass_over(frame, self._plan.layout)

        return confirmed(ARM_QUESTION, self.stop_requested, wait)


def main(argv: list[str] | None = None) -> int:
    """Entry point of ``emb-run``: a signal ends it at once until a run begins, and with stop frames from then on."""
    try:
        args = parser().parse_args(argv)
        if args.write_bench is not None:
            return _write_bench(args.write_bench)
        plan = prepare(args)
        console = Operator(plan, StopRequest())
        try:
            with log_folder(plan.log), shown(plan, console.stop_requested):
                if plan.stage is Stage.READ_ONLY:
                    return _read(plan, console)
                return _experiment(plan, console)
        except RefusedError as err:
            if plan.json:
                show(as_json(summary.refusal(err, plan.iface)))
            raise
    except EmbError as err:
        return complain("emb-run", err)


@contextmanager
def shown(plan: Plan, stop_requested: Callable[[], bool]) -> Iterator[None]:
    """While this lasts, another process shows the growing logs of a plan, where ``--live`` asks for that.

    On a terminal the page stays afterwards, until Ctrl-C: a run is over before a browser has been opened.
    """
    if plan.live is None:
        yield
        return
    if not HAS_CHILD_PROCESSES:
        raise UsageError("--live: needs Linux; emb-replay live shows a run from another terminal")
    entries = list(metadata.entry_points(group=VIEWERS, name="live"))
    if not entries:
        raise UsageError("--live: no module is installed that shows a run; emb_bench has one")
    one = names_a_file(plan.log)
    document = {
        "folder": str(plan.log.parent if one else plan.log),
        "pattern": f"{glob.escape(plan.log.stem)}*{glob.escape(plan.log.suffix)}" if one else "*.mcap",
        "port": plan.live,
    }
    try:
        child = Child("live", entries[0].value, document, VIEWER_TIMEOUT)
    except OSError as err:
        raise UsageError(f"--live: {err}") from err
    try:
        page, addresses = child.ready
        mention(f"live at {addresses}")
        if plan.open:
            _open(page)
        yield
        if sys.stdout is not None and sys.stdout.isatty() and not stop_requested():
            mention(f"page stays at {page} until Ctrl-C")
            while child.alive and not stop_requested():
                time.sleep(LISTEN_NS * 1e-9)
    finally:
        child.end()


def _open(page: str) -> None:
    import webbrowser  # only here: it looks for programs

    if not webbrowser.open(page):
        mention(f"--open: no browser is found here; open {page} in one")


def _experiment(plan: Plan, console: Console) -> int:
    reporter = None if plan.report is None else _reporter(plan.report)
    document, exit_code = experiment(plan, log_path(plan.log), console)
    text = as_json(document) if plan.json else summary.text(document, plan.verbose)
    show(text.partition("\n")[0] if plan.quiet else text)
    if reporter is not None and document["log"] is not None:
        reported = _report(reporter, document["log"], plan)
        return exit_code or reported
    return exit_code


def _reporter(page: Path) -> str:
    """Module whose command ``report`` writes a page; asked for before the run."""
    entries = list(metadata.entry_points(group=VIEWERS, name="report"))
    if not entries:
        raise UsageError("--report: no module is installed that writes a page; emb_bench has one")
    if page.suffix not in (".html", ".htm"):
        raise UsageError(f"--report {page}: expected a name that ends in .html or .htm")
    if not page.absolute().parent.is_dir():
        raise UsageError(f"--report: {page.absolute().parent} is no folder")
    if page.is_dir() or not os.access(page.absolute().parent, os.W_OK):
        raise UsageError(f"--report {page}: expected a file that can be written")
    return entries[0].value


def _report(module: str, log: str, plan: Plan) -> int:
    """Have a process without the real-time settings of this one estimate, and write the page; its exit code."""
    command = [sys.executable, "-P", "-m", module, "report", log, "--output", str(plan.report)]
    return subprocess.run(command, stdout=sys.stderr if plan.json else None, check=False).returncode


def _read(plan: Plan, console: Console) -> int:
    path = log_path(plan.log, LISTEN_ONLY_LOG)
    transport, clock = open_transport(plan.iface, plan.bench)
    try:
        document, lines = listen_only(plan, Bus(plan.iface, transport, clock), path, console)
    finally:
        transport.close()
    show(as_json(document) if plan.json else summary.listen_text(document, lines))
    exit_code: int = document["exit_code"]
    return exit_code


def _write_bench(path: Path) -> int:
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(shipped_bench_text())
    except FileExistsError as err:
        there = "it is a folder: name a file in it" if path.is_dir() else "there is one already: choose another name"
        raise BenchFileError(f"--write-bench {path}: {there}") from err
    except OSError as err:
        raise BenchFileError(f"--write-bench {path}: {err.strerror}") from err
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
