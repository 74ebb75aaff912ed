"""Agreement of a mapped drive with a bench file, checked before anything is opened."""

from __future__ import annotations

from emb_runtime.config.bench import Bench
from emb_runtime.drives.mapping import Mapping, MappingError, Measured
from emb_runtime.errors import BenchFileError
from emb_runtime.safety.end_stop import released_speed

HIGHEST_BUS_LOAD = 0.8  # Beyond it, at worst-case bit stuffing, frames wait for each other
COARSEST_CURRENT = 0.1  # Coarsest step of a command [A]
LONGEST_PAIR_PERIODS = 0.5  # Longest ``can.pair_within``, in periods: later frames are of the next sample


def require_fit(mapping: Mapping, bench: Bench) -> None:
    """Refuse a mapping that does not cover what the bench may command and measure.

    Raises:
        MappingError: a range or step of the mapping is not enough for the bench, or a time-out too long.
        BenchFileError: the bench file does not declare what the drive does.
    """
    if bench.can.mapping not in ("", mapping.sha256):
        raise MappingError(
            f"{mapping.name}: its SHA-256 with its DBC is {mapping.sha256}, the bench file was made for another "
            f"(can.mapping = {bench.can.mapping[:12]}…)"
        )
    limits, command = bench.limits, mapping.command
    amperes = sorted((command.low / command.factor, command.high / command.factor))
    if not (amperes[0] <= -limits.current and limits.current <= amperes[1]):
        raise MappingError(
            f"{mapping.name}: can.signals.command.range: {amperes[0]:.4g} to {amperes[1]:.4g} A does not cover the "
            f"bench's ±{limits.current:g} A"
        )
    step = command.field.step(command.high) / abs(command.factor)
    if not step <= COARSEST_CURRENT:
        raise MappingError(
            f"{mapping.name}: can.signals.command: a step of {step:.3g} A is too coarse, expected at most "
            f"{COARSEST_CURRENT:g} A"
        )
    _cover(mapping, mapping.angle, "angle", limits.angle, "rad")
    _cover(mapping, mapping.velocity, "velocity", (-limits.velocity, limits.velocity), "rad/s")
    if mapping.pair_within > LONGEST_PAIR_PERIODS * bench.timing.sample_time:
        raise MappingError(
            f"{mapping.name}: can.pair_within: expected at most half of the bench's sample time, got "
            f"{mapping.pair_within:g} s"
        )
    if mapping.watchdog > bench.node.watchdog:
        raise MappingError(
            f"{mapping.name}: node.watchdog: {mapping.watchdog:g} s is longer than the bench's node.watchdog = "
            f"{bench.node.watchdog:g} s"
        )
    if (worst := released_speed(bench, mapping.watchdog)) > mapping.end_stop_speed:
        raise MappingError(
            f"{mapping.name}: node.end_stop_speed: without host or cable the drive holds its current for "
            f"{mapping.watchdog:g} s and lets go: the brake may reach {worst:.4g} rad/s, and bears "
            f"{mapping.end_stop_speed:g} rad/s; narrow the bench's limits"
        )
    if (load := mapping.bus_load(bench.timing.sample_time, bench.can.bitrate)) > HIGHEST_BUS_LOAD:
        raise BenchFileError(
            f"can.bitrate: at {bench.can.bitrate} bit/s the drive's frames take {load:.0%} of its bus at worst, "
            f"expected at most {HIGHEST_BUS_LOAD:.0%}"
        )
    least = 1 if mapping.polled else 0
    low, high = bench.shield.frame_age
    if high < 1 or low != least:
        raise BenchFileError(
            f"shield.frame_age: a mapped drive does not answer by sample: declare [{least}, 1] or a later end, got "
            f"[{low}, {high}]; --zero measures it"
        )


def _cover(mapping: Mapping, measured: Measured, name: str, wanted: tuple[float, float], unit: str) -> None:
    if measured.wrap:
        return  # its range is that of one turn
    low, high = sorted(value * measured.factor + measured.offset for value in (measured.low, measured.high))
    if not (low <= wanted[0] and wanted[1] <= high):
        raise MappingError(
            f"{mapping.name}: can.signals.{name}.range: {low:.4g} to {high:.4g} {unit} does not cover the bench's "
            f"{wanted[0]:g} to {wanted[1]:g} {unit}"
        )
