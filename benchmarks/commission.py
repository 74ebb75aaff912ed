"""Commissioning of random brakes: are the limits held, and is the truth inside of the ranges that are written?

Each brake has parameters within a factor of two of nominal, all four, drawn log-uniformly; its sensors have half to all
of the noise of the data sheet, and its delays are drawn too. A data sheet says: all four within a factor of two, the
noise at most, commands and samples up to three samples late (or a current that lags by up to 2 ms). The plants take
turns: ``exact``; ``late`` (commands 0 to 2 samples late, samples 0 or 1); ``lag`` (0.5 to 2 ms); ``rough`` (the bench
file's, with the curve of its stiffness inside of the factor of two); ``mapped`` (a drive of its own protocol
through its mapping, commands 0 or 1 sample late; an ODrive, or those of ``--drives`` in turns).

A limit counts as passed where the true angle or velocity in any period of any run was beyond the bench's.

With ``--observer`` the velocity of each brake is an observer's of 800 to 4000 rad/s, drawn log-uniformly, and the data
sheet does not say where it comes from. Counted is how many of the written files declare an observer that is no faster.

With ``--outside`` each brake has one parameter, in turns, that is 1 to 10 % below or above the data sheet's range.
Counted is how many end with that range named, no bench file written and no limit passed.

    python benchmarks/commission.py --brakes 50
    python benchmarks/commission.py --brakes 20 --outside
    python benchmarks/commission.py --brakes 20 --observer
    python benchmarks/commission.py --brakes 50 --plants mapped --drives vesc mit
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import math
import re
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "examples" / "drives"))  # which registers sim-drive

import simulated_drives
from emb_bench.commission.commissioning import Commissioning
from emb_bench.config.bench import Bench, load_bench, parse_bench
from emb_bench.sim import transport
from emb_bench.sim.node import BrakeNode
from emb_bench.sim.simulated_brake import SimulatedBrake
from emb_runtime.cli.main import main as emb_run
from emb_runtime.config.bench import PARAMETER_NAMES, shipped_bench_text
from emb_runtime.drives.mapping_file import load_mapping
from emb_runtime.errors import EmbError

FACTOR = 2.0
PLANTS = ("exact", "late", "lag", "rough", "mapped")
MAPPINGS = Path(__file__).parents[1] / "examples" / "drives"
BORNE = 5000.0  # Speed into an end stop that the brake bears: a data sheet of a factor of two promises no less [rad/s]
CURVE = 1.2  # Share of the factor of k_1 that the curve of ``rough`` needs: 10 % at 100 rad, and 2 % of hysteresis

brakes: list[SimulatedBrake] = []  # Every simulated brake that was opened, for its true extremes


def recorded(kind: type[SimulatedBrake]) -> Callable[..., SimulatedBrake]:
    """A kind of brake whose brakes are remembered."""

    def make(*args: Any, **options: Any) -> SimulatedBrake:
        brakes.append(kind(*args, **options))
        return brakes[-1]

    return make


def run(arguments: Sequence[str]) -> dict[str, Any]:
    """``emb-run --json`` in this process, for the true extremes of its brake."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exit_code = emb_run(list(arguments))
    return {**json.loads(printed.getvalue()), "exit_code": exit_code}


def mapped_iface(folder: Path, name: str) -> str:
    """A simulated drive with its mapping."""
    text = (MAPPINGS / f"{name}.toml").read_text()
    (folder / f"{name}.dbc").write_text((MAPPINGS / f"{name}.dbc").read_text())
    mapping = folder / f"{name}.toml"
    mapping.write_text(re.sub(r"(?m)^end_stop_speed = [0-9.]+", f"end_stop_speed = {BORNE}", text))
    return f"map:{mapping}@sim-drive:{name},"


def sheet_text(plant: str, generator: np.random.Generator, polled: bool = False) -> str:
    """The data sheet's bench file, with the plant ``drawn`` that stands on the bench."""
    brake = load_bench().brake
    rows = [f"{n} = [{getattr(brake, n) / FACTOR!r}, {getattr(brake, n) * FACTOR!r}]" for n in PARAMETER_NAMES]
    text = re.sub(r"(?ms)^\[sensors\].*?(?=^\[)", "", shipped_bench_text())  # the sheet does not say it
    text = text.replace("[limits] ", "\n".join(["[ranges.sheet]", *rows, "", "[limits] "]), 1)
    text = text.replace('ranges        = "envelope"', 'ranges = "sheet"', 1)
    drawn = "[plants.drawn]\n"
    if plant == "observer":
        # Of 1 mrad in the angle at most, where the observer overshoots.
        text = text.replace("velocity = 1.0 ", "velocity = 1.8 ", 1)
        drawn += f"observer_bandwidth = {800.0 * 5.0 ** generator.uniform()!r}\n"
    if plant == "late":
        text = text.replace("frame_age     = [0, 0]", "frame_age = [0, 3]", 1)
        drawn += f"command_delay = {generator.integers(3)}\nmeasurement_delay = {generator.integers(2)}\n"
    if plant == "mapped":
        text = text.replace("frame_age     = [0, 0]", f"frame_age = [{int(polled)}, 3]", 1)
        drawn += f"command_delay = {generator.integers(2)}\n"
    if plant in ("lag", "rough"):
        text = text.replace("current_lag   = 0.0", "current_lag = 0.002", 1)
        drawn += f"current_lag = {generator.uniform(5e-4, 2e-3)!r}\n"
    if plant == "rough":
        text = text.replace("break_away    = 1.0", "break_away = 1.3", 1).replace(
            "f_l           = 0.0", "f_l = 2e-6", 1
        )
        drawn += "break_away = 1.2\nstribeck_velocity = 30.0\nf_l = 1e-6\nquadratic = 0.001\nhysteresis = 0.02\n"
        drawn += "clock_jitter = 1e-5\n"
    return f"{text}\n{drawn}"


def put_outside(number: int, drawn: dict[str, float], sheet: Bench) -> str:
    """Put one parameter of a brake 1 to 10 % outside of the data sheet's range; its name."""
    generator = np.random.default_rng([25, number])
    name: str = PARAMETER_NAMES[number % len(PARAMETER_NAMES)]
    share = float(generator.uniform(0.01, 0.1))
    ends = sheet.range_set("sheet")
    below = bool(generator.integers(2))
    drawn[name] = getattr(ends.low, name) * (1.0 - share) if below else getattr(ends.high, name) * (1.0 + share)
    return name


def commissioned(
    number: int,
    folder: Path,
    drive: str,
    say: Callable[[str], None],
    *,
    is_outside: bool = False,
    is_observed: bool = False,
) -> dict[str, Any]:
    """One brake, drawn and taken into service; a drive is asked for where the plant is ``mapped``."""
    generator = np.random.default_rng([16, number])
    plant = "observer" if is_observed else PLANTS[number % len(PLANTS)]
    polled = load_mapping(MAPPINGS / f"{drive}.toml").polled
    sheet = parse_bench(sheet_text(plant, generator, polled), "the data sheet")
    drawn = {n: getattr(sheet.brake, n) * FACTOR ** generator.uniform(-1.0, 1.0) for n in PARAMETER_NAMES}
    if plant == "rough":
        drawn["k_1"] = min(drawn["k_1"], sheet.brake.k_1 * FACTOR / CURVE)
    outside = put_outside(number, drawn, sheet) if is_outside else ""
    noise = {n: getattr(sheet.noise, n) * generator.uniform(0.5, 1.0) for n in ("angle", "velocity")}
    options = {"plant": "drawn", "seed": 1000 * number + 1, **drawn, **{f"{n}_noise": v for n, v in noise.items()}}
    bus = mapped_iface(folder, drive) if plant == "mapped" else "sim:"
    iface = bus + ",".join(f"{name}={value}" for name, value in options.items())
    brakes.clear()
    begin = time.perf_counter()
    name = drive if plant == "mapped" else plant
    row: dict[str, Any] = {"number": number, "plant": name, "truth": drawn, "outside": outside, "error": ""}
    try:
        result = Commissioning(folder, sheet, iface, ("--yes",), run, say).run()
    except EmbError as err:
        row["error"] = str(err)
        result = None
    row["seconds"] = time.perf_counter() - begin
    row["passed"] = sum(_passed(brake, sheet.limits.angle, sheet.limits.velocity) for brake in brakes)
    row["runs"] = len(brakes)
    if outside:
        widened = re.search(r"widen ([\w, ]+) in \[ranges\.sheet\]", row["error"])
        row["named"] = widened is not None and outside in widened[1].split(", ")
        row["written"] = (folder / "bench.toml").exists()
        row["refused"] = row["named"] and not row["written"] and not row["passed"]
    if result is not None:
        one, found = result.found.identified, result.ranges
        row |= {"model": one.model, "fits": one.fits, "delays": (one.command_delay, one.measurement_delay)}
        row["inside"] = {n: bool(found[n][0] <= drawn[n] <= found[n][1]) for n in PARAMETER_NAMES}
        row["in_95"] = {n: bool(one.intervals[n][0] <= drawn[n] <= one.intervals[n][1]) for n in PARAMETER_NAMES}
        row["width"] = {n: (found[n][1] - found[n][0]) / drawn[n] for n in PARAMETER_NAMES}
        written = load_bench(result.bench)
        instruments = sheet.plants["drawn"].instruments
        late = instruments.command_delay + instruments.measurement_delay + int(plant == "mapped" and polled)
        row["delay_covered"] = written.shield.frame_age[0] <= late <= written.shield.frame_age[1]
        row["lag_covered"] = sheet.plants["drawn"].mechanics.current_lag <= written.shield.current_lag * 1.001
        row["noise_covered"] = noise["angle"] <= written.noise.angle and (
            plant == "observer" or noise["velocity"] <= written.noise.velocity
        )
        bandwidth = instruments.observer_bandwidth
        row["velocity_covered"] = written.sensors.velocity == ("observer" if bandwidth else "sensor")
        if bandwidth:
            least = written.sensors.observer_bandwidth or math.inf
            row |= {"bandwidth": bandwidth, "share": least / bandwidth, "velocity_covered": least <= bandwidth}
    return row


def _passed(brake: SimulatedBrake, angle: tuple[float, float], velocity: float) -> bool:
    low, high = brake.angle_range
    return low < angle[0] or high > angle[1] or brake.top_speed > velocity


def main() -> None:
    """Draw, commission, count."""
    p = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    p.add_argument("--brakes", type=int, default=50)
    p.add_argument("--first", type=int, default=0, help="number of the first brake, which is its seed too")
    p.add_argument("--plants", nargs="+", default=PLANTS, choices=PLANTS, help="brakes of other plants are left out")
    kinds = sorted(simulated_drives.DRIVES)
    p.add_argument("--drives", nargs="+", default=("odrive",), choices=kinds, help="of those mapped")
    p.add_argument("--outside", action="store_true", help="brakes of which one parameter is outside of the data sheet")
    p.add_argument(
        "--observer", action="store_true", help="brakes whose velocity is an observer's, in place of the plants"
    )
    p.add_argument("--keep", type=Path, help="folder for the logs; without, they are deleted")
    p.add_argument("-o", "--output", type=Path, help="a line of JSON for each brake")
    args = p.parse_args()
    setattr(transport, "BrakeNode", recorded(BrakeNode))  # noqa: B010  mypy would refuse the plain assignment
    setattr(simulated_drives, "DRIVES", {name: recorded(kind) for name, kind in simulated_drives.DRIVES.items()})  # noqa: B010
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        numbers = [
            n
            for n in range(args.first, args.first + args.brakes)
            if args.observer or PLANTS[n % len(PLANTS)] in args.plants
        ]
        for number in numbers:
            folder = (args.keep or Path(scratch)) / str(number)
            folder.mkdir(parents=True)
            drive = args.drives[number // len(PLANTS) % len(args.drives)]
            row = commissioned(
                number, folder, drive, lambda _: None, is_outside=args.outside, is_observed=args.observer
            )
            rows.append(row)
            if args.output:
                with args.output.open("a") as file:
                    file.write(json.dumps(row) + "\n")
            if args.outside:
                verdict = f"{row['outside']} {'refused' if row['refused'] else 'MISSED'}"
            else:
                verdict = f"truth {'inside' if all(row.get('inside', {'': False}).values()) else 'OUTSIDE'}"
            print(
                f"{number:3} {row['plant']:<6} {row['seconds']:6.1f} s, {row['runs']} buses, limits passed "
                f"{row['passed']}, {verdict}, {row.get('model', '')} {row['error']}",
                flush=True,
            )
    if args.outside:
        refused = sum(row["refused"] for row in rows)
        print(
            f"| commissioning of {len(rows)} brakes 1 to 10 % outside of one range of the data sheet: range named, "
            f"nothing written, no limit passed | {len(rows)} | {refused} |"
        )
        return
    done = [row for row in rows if "inside" in row]
    inside, passed = sum(all(row["inside"].values()) for row in done), sum(row["passed"] for row in rows)
    plants = "observer" if args.observer else ", ".join(args.plants)
    print(
        f"| commissioning of {len(rows)} random brakes ({plants}): limits passed; truth inside of the "
        f"written ranges | 0; {len(rows)} | {passed}; {inside} |"
    )
    for name in PARAMETER_NAMES:
        within = sum(row["in_95"][name] for row in done)
        width = np.median([row["width"][name] for row in done])
        print(f"  {name}: inside of the 95 % interval {within}, width of the written range {width:.0%} (median)")
    for row in done if args.observer else ():
        print(f"  observer of {row['bandwidth']:.0f} rad/s: {row['share']:.1%} of it written")
    for key in ("delay_covered", "lag_covered", "noise_covered", "velocity_covered", "fits"):
        print(f"  {key.replace('_', ' ')}: {sum(row[key] for row in done)} of {len(done)}")
    for plant in sorted({row["plant"] for row in done}):
        seconds = [row["seconds"] for row in done if row["plant"] == plant]
        print(f"  {plant}: {np.median(seconds):.0f} s each (median)")


if __name__ == "__main__":
    main()
