"""Compatibility of a trained actor with a bench: what has to be as in the training, and what to change otherwise.

A training may have a shield of its own (:attr:`emb_train.envs.conditions.Conditions.shield_ranges`), for brakes that
the bench's shield does not cover. Its actor is then for a bench file that names these brakes, and for no other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict

from emb_runtime.config.bench import Bench, Ranges
from emb_runtime.errors import UsageError


def unfit(bench: Bench, ranges: Ranges) -> str:
    """Reason why the bench's shield does not cover these brakes, and what to do; empty if it does."""
    box = bench.range_set(bench.shield.ranges)
    uncovered = box.uncovered(ranges.low, ranges.high)
    if not uncovered:
        return ""
    names = [f"{n} from {getattr(ranges.low, n):g} to {getattr(ranges.high, n):g}" for n in uncovered]
    covers = [f"{n} from {getattr(box.low, n):g} to {getattr(box.high, n):g}" for n in uncovered]
    middle = {n: 0.5 * (getattr(ranges.low, n) + getattr(ranges.high, n)) for n in ranges.low._fields}
    brake = [f"{n} = {middle[n]:g} in [brake]" for n in ranges.uncovered(bench.brake, bench.brake)]
    lines = " and ".join([*brake, f'ranges = "{ranges.name}" in [shield]'])
    return (
        f"it is for brakes with {', '.join(names)}, and the bench's shield covers {', '.join(covers)}: make a bench "
        f"file with emb-run --write-bench FILE, write {lines}, and give it to emb-export and emb-run with --bench FILE"
    )


def require_fit(bench: Bench, ranges: Ranges, what: str) -> None:
    """Check that the bench's shield covers the brakes that an actor is for.

    Raises:
        UsageError: it does not.
    """
    if said := unfit(bench, ranges):
        raise UsageError(f"{what}: {said}")


def require_alike(trained: Bench, bench: Bench, what: str) -> None:
    """Check that a bench is one that an actor was trained for; its shield may be another.

    Raises:
        UsageError: limits, noise, timing, inertia or gear ratio differ.
    """
    for name in ("limits", "noise", "timing"):
        before, now = asdict(getattr(trained, name)), asdict(getattr(bench, name))
        for key in before:
            if before[key] != now[key]:
                _differ(what, f"{name}.{key}", before[key], now[key])
    for key in ("J", "gamma"):
        if getattr(trained.brake, key) != getattr(bench.brake, key):
            _differ(what, f"brake.{key}", getattr(trained.brake, key), getattr(bench.brake, key))


def _differ(what: str, key: str, trained: object, bench: object) -> None:
    raise UsageError(f"{what}: it was trained with {key} = {trained}, the bench has {bench}: train it for this bench")


def shield_changes(trained: Bench, bench: Bench) -> str:
    """Differences of the bench's shield from that of the training; empty if there are none."""
    return ", ".join(_changes(trained, bench))


def _changes(trained: Bench, bench: Bench) -> Iterator[str]:
    before, now = trained.shield._asdict(), bench.shield._asdict()
    boxes = [b.range_set(b.shield.ranges) for b in (trained, bench)]
    if (boxes[0].low, boxes[0].high) == (boxes[1].low, boxes[1].high):  # whatever they are called
        before["ranges"] = now["ranges"]
    for key, value in before.items():
        if value != now[key]:
            yield f"{key} {value}, here {now[key]}"
