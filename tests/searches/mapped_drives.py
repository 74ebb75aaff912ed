"""The second guard of mapped drives: random mappings and commands, and what their bytes say.

    python -m tests.searches.mapped_drives [--mappings 2000] [--commands 50] [--seed 0]

Each mapping has a command of random place, size, order, scale, unit, sign and protection. Half of the frames have a
random bit flipped between encoder and guard, and one command in ten is NaN, infinite or too large. What reached the bus
is read by a decoder that shares no code with the product.
"""

from __future__ import annotations

import argparse
import math
import random
import sys
import time

from emb_runtime.drives.mapping_file import parse_mapping
from emb_runtime.drives.wire import Encoder
from emb_runtime.drives.wire_guard import WireGuard, WireGuardError
from emb_runtime.errors import FrameError
from emb_runtime.records import Frame
from tests.drives import LIMIT, RandomMapping


def main() -> int:
    """Print what came of all commands; exit status 1 if one reached the bus that says something else."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--mappings", type=int, default=2000)
    p.add_argument("--commands", type=int, default=50)
    p.add_argument("--seed", type=int, default=0)
    args = p.parse_args()
    begin = time.perf_counter()
    counts = {"left": 0, "refused, flipped": 0, "refused, impossible": 0, "refused, valid": 0, "wrong on the bus": 0}
    for number in range(args.mappings):
        drawn, draw = RandomMapping(args.seed * 1_000_003 + number), random.Random(number)
        bus: list[Frame] = []
        mapping = parse_mapping(drawn.toml, drawn.dbc, "random.toml")
        encoder, guard = Encoder(mapping), WireGuard(mapping, LIMIT, bus.append)
        for _ in range(args.commands):
            current = draw.uniform(-LIMIT, LIMIT)
            if impossible := draw.random() < 0.1:
                current = draw.choice((math.nan, math.inf, -math.inf, draw.uniform(1.1, 50.0) * LIMIT, -1e308))
            flipped, before = draw.random() < 0.5, len(bus)
            try:
                frame = encoder.command(current)
                if flipped:
                    bit = draw.randrange(64)
                    data = bytearray(frame.data)
                    data[bit // 8] ^= 1 << bit % 8
                    frame = frame._replace(data=bytes(data))
                guard.command(frame, current)
            except (FrameError, WireGuardError):
                counts[
                    "refused, impossible" if impossible else "refused, flipped" if flipped else "refused, valid"
                ] += 1
                counts["wrong on the bus"] += len(bus) > before
                if drawn.kind != "none":  # a frame that was refused has spent the encoder's counter
                    encoder, guard = Encoder(mapping), WireGuard(mapping, LIMIT, bus.append)
                continue
            counts["left"] += 1
            said = drawn.amperes(bus[-1].data)
            counts["wrong on the bus"] += not abs(said - current) <= 0.51 * drawn.ampere_step
    total = args.mappings * args.commands
    print(f"{total} commands of {args.mappings} mappings in {time.perf_counter() - begin:.0f} s")
    for name, count in counts.items():
        print(f"  {name:<20} {count:>8}")
    found = f"{counts['wrong on the bus']} of {total:,}; {counts['refused, valid']}"
    print(
        f"| random commands of {args.mappings} random mappings: wrong on the bus; valid and refused | 0; 0 | {found} |"
    )
    return int(counts["wrong on the bus"] > 0 or counts["refused, valid"] > 0)


if __name__ == "__main__":
    sys.exit(main())
