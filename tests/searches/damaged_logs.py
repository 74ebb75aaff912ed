"""Outcomes of reading damaged logs, counted by damage; fails if one gives a wrong number without a word.

python -m tests.searches.damaged_logs
"""

from __future__ import annotations

import random
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from emb_bench import api
from emb_bench.logs.mcap_file import MAGIC
from emb_runtime.records import CycleRecord
from tests.bench.damaged import (
    CHUNK,
    DATA_END,
    FOOTER,
    Read,
    judge,
    read,
    record,
    records,
    rewritten,
    spliced,
    with_field,
    without,
)

CHUNK_SIZE = 2048
"""Size of the log that is damaged, once unpacked [bytes]: its last chunk has some hundred places to be cut at."""
FLIPS = 300
OUTCOMES = COMPLETE, IN_PART, REFUSED, WRONG = ("complete, right", "in part, said so", "refused", "WRONG")

Damage = Callable[[Path], object]  # Done to a file, which is whole before


def outcomes(path: Path) -> Iterator[tuple[str, Counter[str]]]:
    """Counts the outcomes of each kind of damage to a log; the file is changed."""
    rewritten(path, chunk_size=CHUNK_SIZE)
    data, whole = path.read_bytes(), read(path)
    assert whole is not None
    assert not whole.said
    for kind, damages in _kinds(data):
        counts = Counter[str]()
        for damage in damages:
            path.write_bytes(data)
            damage(path)
            counts[_outcome(path, whole)] += 1
        yield kind, counts


def _outcome(path: Path, whole: Read) -> str:
    try:
        found = judge(path, whole)
    except Exception:  # a wrong number, or what a user would see as a traceback
        return WRONG
    if found is None:
        return REFUSED
    return IN_PART if found.said else COMPLETE


def _kinds(data: bytes) -> Iterator[tuple[str, list[Damage]]]:
    first, *_, (_, begin, end) = (r for r in records(data) if r[0] == CHUNK)
    fields = [*(("/cycle", name) for name in CycleRecord._fields), ("/can/rx", "id"), ("/can/rx", "data")]
    topics = ("/cycle", "/can/rx", "/clock", "/safety")
    later = [partial(rewritten, change=with_field(topic, "novelty", "int64")) for topic in topics]
    nothing = data[: first[1]] + record(DATA_END, bytes(4)) + record(FOOTER, bytes(20)) + MAGIC
    yield "cut at each byte of the last chunk", [_put(data[:at]) for at in range(begin, end)]
    yield "cut elsewhere", [_put(data[:at]) for at in [*range(1, begin, 499), *range(end, len(data), 211)]]
    yield "one to four flipped bytes", _flips(data)
    yield "wrong schema: a field is missing", [partial(rewritten, change=without(*field)) for field in fields]
    yield "wrong schema: a field is text", [_as_text(*field) for field in fields]
    yield "empty, or of another format", [_put(content) for content in (b"", b"x", MAGIC, MAGIC * 2, bytes(1000))]
    yield "zero messages", [_put(nothing)]
    yield "of a later version: more fields, other records", [*later, partial(spliced, extra=record(0x90, b"new"))]
    yield "of another program; two runs in one", [partial(rewritten, library="other"), partial(rewritten, runs=2)]


def _put(content: bytes) -> Damage:
    return lambda path: path.write_bytes(content)


def _as_text(topic: str, name: str) -> Damage:
    def values(where: str, _n: int, row: dict[str, Any]) -> dict[str, Any]:
        return {**row, name: str(row[name])} if where == topic else row

    return partial(rewritten, change=with_field(topic, name, "string"), values=values)


def _flips(data: bytes) -> list[Damage]:
    rng, damages = random.Random(1), list[Damage]()
    for _ in range(FLIPS):
        flipped = bytearray(data)
        for _ in range(rng.randint(1, 4)):
            flipped[rng.randrange(len(data))] ^= rng.randint(1, 255)
        damages.append(_put(bytes(flipped)))
    return damages


def main() -> int:
    """Print the outcomes."""
    wrong = total = 0
    print(f"{'damage':56}" + "".join(f"{outcome:>18}" for outcome in OUTCOMES))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "short.mcap"
        api.simulate(path, seed=1, duration=0.04)
        for kind, counts in outcomes(path):
            print(f"{kind:56}" + "".join(f"{counts[outcome]:18}" for outcome in OUTCOMES))
            wrong, total = wrong + counts[WRONG], total + counts.total()
    print(f"| damaged logs that give a wrong number without a warning, or a traceback | 0 | {wrong} of {total:,} |")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
