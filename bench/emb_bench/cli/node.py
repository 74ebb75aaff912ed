"""``emb-node``: the simulated brake on a real bus."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Callable
from pathlib import Path

from emb_bench.config.bench import load_bench
from emb_bench.sim.node import BrakeNode
from emb_bench.sim.simulated_brake import read_brake
from emb_bench.sim.transport import Device
from emb_runtime.can.interfaces import open_transport
from emb_runtime.can.messages import load_layout
from emb_runtime.can.transport import Transport
from emb_runtime.errors import EXIT_DONE, EmbError, UsageError
from emb_runtime.numbers import plain
from emb_runtime.safety import watchdog_process
from emb_runtime.system import realtime
from emb_runtime.system.clock import Clock
from emb_runtime.system.terminal import Parser, complain, json_document, mention, show

PRIORITY = watchdog_process.PRIORITY + 5
"""Above all of emb-run, where they share one processor: a real node's clock waits for no computer. So a pair of frames
is sent before it is read, and a loop or a watchdog that is killed does not hold the node up while the kernel takes it
down."""

MAX_FRAMES = 64  # Most frames taken per tick: a babbling commander must not hold the node up

EPILOG = """\
example:
  emb-node --iface vcan0 --brake plant=stribeck,f_v=3e-5

exit codes: 0 ended (duration over, Ctrl-C or SIGTERM), 2 usage, 4 bus
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = Parser(
        prog="emb-node",
        description="A simulated electromechanical brake as a CAN node with its own clock. It measures, and obeys\n"
        "only fresh, valid, enabled commands. It brakes in a period without one, and begins a safe stop\n"
        "when commands stop.",
        epilog=EPILOG,
    )
    p.add_argument("--iface", required=True, help="SocketCAN interface (vcan0, can0)")
    p.add_argument("--bench", type=Path, metavar="FILE", help="bench file (default: the shipped drum brake)")
    p.add_argument(
        "--brake", default="", metavar="plant=stribeck,f_v=3e-5,...",
        help="as for `emb-run --iface sim:`: one of the bench's plants, true parameters (default: nominal), seed (1), "
        "angle_noise, velocity_noise (the bench file's), charge=1: also send the integral of the current, "
        "temperature [degC] with supply_voltage [V]: also send them",
    )  # fmt: skip
    p.add_argument("--duration", type=float, metavar="S", help="seconds to run (default: until stopped)")
    p.add_argument("--no-rt", action="store_true", help="leave scheduling and memory alone")
    p.add_argument("--json", action="store_true", help="print the summary as JSON")
    return p


def run_node(
    node: Device,
    transport: Transport,
    clock: Clock,
    period_ns: int,
    periods: int | None,
    stop_requested: Callable[[], bool],
) -> int:
    """Drive a node in real time on an absolute grid, for some periods or without end.

    Late ticks are skipped, never made up in a burst; returns their number.
    """
    passed = skipped_total = 0
    deadline_ns = clock.now_ns() + period_ns
    while not stop_requested() and (periods is None or passed < periods):
        # Asleep until the tick, not woken by each frame: frames are received at the tick, and act no earlier.
        skipped = (clock.sleep_until(deadline_ns) - deadline_ns) // period_ns
        for _ in range(MAX_FRAMES):
            if (frame := transport.receive(0)) is None:
                break
            node.receive(frame)
        for frame in node.tick(skipped):
            transport.send(frame)
        passed += skipped + 1
        skipped_total += skipped
        deadline_ns += (skipped + 1) * period_ns
    return skipped_total


def main(argv: list[str] | None = None) -> int:
    """Entry point of ``emb-node``."""
    args = parser().parse_args(argv)
    try:
        return _run(args)
    except EmbError as err:
        return complain("emb-node", err)


def _run(args: argparse.Namespace) -> int:
    bench = load_bench(args.bench)
    brake = read_brake(args.brake, bench, "--brake: ")
    if args.duration is not None and not 0 < args.duration < 1e6:
        raise UsageError(f"--duration: expected seconds above 0, got {args.duration:g}")
    if args.iface.partition(":")[0] == "sim":
        raise UsageError("the sim bus has its own node: `emb-run --iface sim:f_v=3e-5` needs no emb-node")
    stop = False

    def request_stop(_signal: int, _frame: object) -> None:
        nonlocal stop
        stop = True

    signal.signal(signal.SIGINT, request_stop)
    signal.signal(signal.SIGTERM, request_stop)
    layout = load_layout()
    transport, clock = open_transport(args.iface, bench, (layout.command.identifier,))
    try:
        node = BrakeNode(
            bench, layout, brake.theta, brake.noise, brake.plant, charge=brake.charge, conditions=brake.conditions
        )
        if not args.no_rt:
            realtime.obtain(priority=PRIORITY)
        parameters = ", ".join(f"{name} = {plain(value, 6)}" for name, value in brake.theta._asdict().items())
        mention(f"emb-node: on {transport.name}, plant {brake.plant.name}, {parameters}")
        periods = None if args.duration is None else round(args.duration / bench.timing.sample_time)
        skipped = run_node(node, transport, clock, bench.timing.sample_time_ns, periods, lambda: stop)
    finally:
        transport.close()
    _print_summary(node, skipped, args.json)
    return EXIT_DONE


def _print_summary(node: BrakeNode, skipped: int, as_json: bool) -> None:
    """Print the counts of the node, and the extremes of the motion."""
    did = {
        "samples": node.samples,
        "skipped_periods": skipped,
        "obeyed": node.obeyed,
        "braked": node.braked,
        "rejected": node.rejected,
        "state": node.state.name,
        "stop_reason": node.stop_reason.name,
    }
    line = (
        f"{node.samples} samples, {skipped} periods skipped; {node.obeyed} commands obeyed, {node.rejected} "
        f"rejected, {node.braked} periods braked; {node.state.name} ({node.stop_reason.name})"
    )
    low, high = node.angle_range
    if as_json:
        moved = {"angle_min": low, "angle_max": high, "top_speed": node.top_speed}
        show(json_document({**did, **moved, "angle": node.angle, "velocity": node.velocity}))
        return
    show(
        f"{line}\nangle {low:.2f}..{high:.2f} rad, top speed {node.top_speed:.1f} rad/s, "
        f"now {node.angle:.3f} rad, {node.velocity:.2f} rad/s"
    )


if __name__ == "__main__":
    sys.exit(main())
