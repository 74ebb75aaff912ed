"""``emb-gateway``: a drive with another DBC as a node on a bus with ``emb.dbc``."""

from __future__ import annotations

import argparse
import select
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from textwrap import dedent

from emb_runtime.can.interfaces import open_transport
from emb_runtime.can.messages import bench_identity, load_layout
from emb_runtime.can.transport import Transport
from emb_runtime.config.bench import load_bench
from emb_runtime.drives.gateway import Gateway
from emb_runtime.drives.mapping import PROPERTIES, Mapping, require_fit
from emb_runtime.drives.mapping_file import load_mapping
from emb_runtime.drives.node import report
from emb_runtime.errors import EXIT_CHECK_FAILED, EXIT_DONE, EmbError, SafetyStopError, UsageError
from emb_runtime.safety.end_stop import released_speed
from emb_runtime.system import realtime
from emb_runtime.system.terminal import (
    Parser,
    StopRequest,
    agreed_to_arm,
    complain,
    is_interactive,
    json_document,
    mention,
    show,
)

PRIORITY = realtime.PRIORITY + 5  # Above the loop's, below its watchdog's
LOOK = 0.05  # Time between two looks at the keyboard [s]
LOOK_NS = 200_000  # Time between two looks at a bus that cannot be waited for [ns]
LONGEST_WAIT_NS = 10_000_000  # Time between two looks at the operator's end [ns]
DESCRIPTION = """\
Translate between a drive with another protocol, on one bus, and emb-run with emb.dbc, on another bus.

The gateway first tests that the drive's time-out switches the current off, if the drive reports its state. Then it
arms the drive by the sequence of the mapping file. The drive stays armed until the gateway ends; without a run it gets
0 A. The gateway is a node: it brakes by itself if no command comes. A second guard checks each frame to the drive.
After a stop that emb-run did not request, the gateway disarms the drive and ends.
"""
EPILOG = """\
example:
  emb-gateway drive.toml --drive can0 --node vcan0

exit codes:
  0  ended by Ctrl-C or SIGTERM, the drive is disarmed
  1  the same, but commands acted later than shield.frame_age declares
  2  usage: wrong argument, a file that is refused
  3  drive disarmed after a stop that emb-run did not request, sensors that contradict each other, or a refused frame
  4  a bus is lost, or the drive cannot be armed
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = Parser(
        prog="emb-gateway",
        description=DESCRIPTION,
        epilog=EPILOG,
    )
    p.add_argument("mapping", type=Path, metavar="FILE", help="mapping file of the drive (TOML)")
    p.add_argument("--drive", required=True, metavar="BUS", help="bus of the drive: can0")
    p.add_argument("--node", required=True, metavar="BUS", help="bus of the node: vcan0, can1")
    p.add_argument("--bench", type=Path, metavar="FILE", help="bench file, the same as for emb-run")
    p.add_argument("--serial", default="", metavar="TEXT", help="serial number of a drive that reports no identity")
    p.add_argument(
        "--listen",
        action="store_true",
        help="only show the samples of a drive that broadcasts: nothing is sent or armed",
    )
    p.add_argument("--yes", action="store_true", help="do not ask before the drive is armed")
    p.add_argument("--no-rt", action="store_true", help="leave scheduling and memory alone")
    p.add_argument("--json", action="store_true", help="print the counts at the end as JSON")
    return p


def main(argv: list[str] | None = None) -> int:
    """Entry point of ``emb-gateway``."""
    args = parser().parse_args(argv)
    try:
        return _serve(args)
    except EmbError as err:
        return complain("emb-gateway", err)


def _serve(args: argparse.Namespace) -> int:
    bench, mapping = load_bench(args.bench), load_mapping(args.mapping)
    require_fit(mapping, bench)
    layout = load_layout()
    if args.drive == args.node:
        raise UsageError(
            f"--node {args.node}: expected another bus than the drive's, whose identifiers differ in meaning"
        )
    if args.listen and mapping.polled:
        raise UsageError(
            f"--listen: {mapping.name} sends nothing unless it is polled; only a drive that broadcasts has samples"
        )
    if "no_identity" in mapping.lost and not (args.serial or args.listen):
        raise UsageError(
            f"{mapping.name} does not say what it is, and nobody has: expected --serial TEXT, the number on the drive"
        )
    speed = released_speed(bench, mapping.longest_hold(bench.timing.sample_time))
    mention(_description(mapping, bench.name, bench_identity(bench.identity_hash), speed, args.serial))
    stop = StopRequest()
    if not args.listen and not _may_arm(args.yes, stop):
        raise SafetyStopError("stopped by the operator before anything was sent")
    infos = mapping.messages.values()
    identifiers = None if any(info.extended for info in infos) else tuple(info.identifier for info in infos)
    with ExitStack() as stack:
        drive_bus, clock = open_transport(args.drive, bench, identifiers)
        stack.callback(drive_bus.close)
        node_bus, _ = open_transport(args.node, bench, (layout.command.identifier,))
        stack.callback(node_bus.close)
        gateway = Gateway(mapping, bench, drive_bus, node_bus, clock, wait_for(drive_bus, node_bus))
        if not args.no_rt:
            realtime.obtain(PRIORITY)
        done = "listening" if args.listen else "armed"
        try:
            gateway.run(stop, lambda: mention(f"{mapping.name}: {done}, node on {args.node}"), arms=not args.listen)
        finally:
            counts = report(gateway.node)
            show(
                json_document(counts) if args.json else "\n".join(f"{name}: {value}" for name, value in counts.items())
            )
    if late := gateway.node.times.too_late:
        mention(f"emb-gateway: TOO LATE: {late}")
    return EXIT_CHECK_FAILED if late else EXIT_DONE


def wait_for(*buses: Transport) -> Callable[[int], None]:
    """A wait of at most a time [ns], until something has come on one of some buses."""
    descriptors = [getattr(bus, "descriptor", None) for bus in buses]
    readable = [each for each in descriptors if each is not None]
    most_ns = LONGEST_WAIT_NS if len(readable) == len(buses) else LOOK_NS

    def wait(longest_ns: int) -> None:
        select.select(readable, [], [], min(longest_ns, most_ns) * 1e-9)

    return wait


def _description(mapping: Mapping, bench: str, identity: int, speed: float, serial: str) -> str:
    lost = "\n".join(f"  {name}: {PROPERTIES[name]}" for name in mapping.lost)
    return (
        dedent(f"""\
        {mapping.name}{f", number {serial}" if serial else ""}, mapping {mapping.sha256}
        bench {bench}, identity {identity:#06x}
        time-out {mapping.watchdog:g} s; host or cable lost at the worst moment: below {speed:.4g} rad/s,
        the brake bears {mapping.end_stop_speed:g} rad/s; what the drive lacks, accepted by the mapping file:
        """)
        + lost
    )


def _may_arm(agreed: bool, stop_requested: Callable[[], bool]) -> bool:
    if agreed or not is_interactive():
        return True
    return agreed_to_arm(stop_requested, lambda: time.sleep(LOOK))


if __name__ == "__main__":
    sys.exit(main())
