"""Policy files of references."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emb_bench.config.bench import Bench
from emb_bench.export.policy_file import model_of, policy_file
from emb_runtime.config.bench import PARAMETER_NAMES, Ranges
from emb_runtime.policy.contract import MIN_VECTORS
from emb_train.reference import FEATURES, box_of, features, set_reference, stored
from emb_train.trial import Task


def bounds(ranges: Ranges) -> dict[str, tuple[float, float]]:
    """Lowest and highest value of each parameter."""
    return {name: (getattr(ranges.low, name), getattr(ranges.high, name)) for name in PARAMETER_NAMES}


REFERENCE = """policy (double[1, %d] inputs) => (double[1, %d] outputs) {
    logarithm = Log (inputs)
    scaled = Gemm (logarithm, scale, middle)
    feature = Clip (scaled, minus_one, one)
    left = Gemm (feature, first, no_first)
    right = Gemm (feature, second, no_second)
    terms = Mul (left, right)
    free = MatMul (terms, table)
    outputs = Clip (free, minus_one, one)
}"""


def reference_file(source: str, bench: Bench) -> bytes:
    """The file of a reference, see :func:`emb_train.reference.stored`.

    Raises:
        UsageError: there is no such reference, or the file is something else.
        BenchFileError: the bench lacks its set of ranges.
        PolicyRefusedError: the file would differ from the table.
    """
    kept = stored(source)
    task = Task.of(kept)
    ranges, table = bench.range_set(task.ranges), kept.array()
    box = box_of(bench, ranges)
    seen = np.random.default_rng(0).uniform(0.4, 1.6, (4 * MIN_VECTORS, FEATURES))
    wanted = np.zeros((len(seen), len(table)))
    for relative, reference in zip(seen.tolist(), wanted, strict=True):
        set_reference(table, features(box, tuple(relative)), reference)
    nominal = np.array([getattr(bench.brake, name) for name in PARAMETER_NAMES])
    kept_of = {name: getattr(kept, name) for name in ("task", "form", "plant", "seed", "command")}
    provenance = {"reference": Path(source).stem, **kept_of}
    low, high = (np.log(np.array(end) * nominal) for end in box)
    width = np.where(high > low, high - low, np.inf)  # 0 for a parameter that is known
    first, second = (np.eye(1 + FEATURES)[:, at] for at in np.triu_indices(1 + FEATURES))  # factors of a term: 1 or φ
    constants: dict[str, NDArray[Any]] = {
        "scale": np.diag(2.0 / width),
        "middle": -((low + high) / width)[None],
        "minus_one": np.array(-1.0),
        "one": np.array(1.0),
        "first": first[1:],
        "no_first": first[:1],
        "second": second[1:],
        "no_second": second[:1],
        "table": np.ascontiguousarray(table.T),
    }
    model = model_of(REFERENCE % (FEATURES, len(table)), constants)
    fields = {"kind": "reference", "inputs": PARAMETER_NAMES, "ranges": bounds(ranges), "gain": kept.gain}
    return policy_file(model, bench, seen * nominal, wanted, provenance, **fields)
