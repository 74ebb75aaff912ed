"""A reference, or a sequence of currents, as a policy file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from onnx import TensorProto, helper

from emb_bench.brake.motion import Floats
from emb_bench.config.bench import Bench
from emb_bench.excitation.reference import parse_excitation
from emb_export.file import VECTORS, graph_of, policy_file
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import UsageError
from emb_runtime.policy.contract import SAMPLE
from emb_runtime.policy.inference import INPUT_NAME, OUTPUT_NAME
from emb_train.structured.law import FEATURES, PRODUCTS, Box, box_of, features, set_reference
from emb_train.structured.stored import stored


def reference_file(source: str, bench: Bench) -> tuple[bytes, float]:
    """The file of a reference, and the largest difference of its levels and switches from the table's.

    Args:
        source: name of a reference that is part of the package, or a ``.json`` file.
        bench: that it is for.

    Raises:
        UsageError: there is no such reference, or the file is something else.
        BenchFileError: the bench lacks its set of ranges.
        PolicyRefusedError: the file would differ from the table.
    """
    kept = stored(source)
    task = kept.asked()
    ranges, table = bench.range_set(task.ranges), kept.array()
    box = box_of(bench, ranges)
    seen = np.random.default_rng(0).uniform(0.4, 1.6, (4 * VECTORS, FEATURES))
    wanted = np.zeros((len(seen), len(table)))
    for relative, reference in zip(seen.tolist(), wanted, strict=True):
        set_reference(table, features(box, tuple(relative)), reference)
    nominal = np.array([getattr(bench.brake, name) for name in PARAMETER_NAMES])
    kept_of = {name: getattr(kept, name) for name in ("task", "form", "plant", "shield", "seed", "command")}
    provenance = {"reference": Path(source).stem, **kept_of}
    nodes = [
        helper.make_node("Log", [INPUT_NAME], ["logarithm"]),
        helper.make_node("Gemm", ["logarithm", "scale", "middle"], ["scaled"]),
        helper.make_node("Clip", ["scaled", "minus_one", "one"], ["feature"]),
        helper.make_node("Gemm", ["feature", "first", "no_first"], ["left"]),
        helper.make_node("Gemm", ["feature", "second", "no_second"], ["right"]),
        helper.make_node("Mul", ["left", "right"], ["terms"]),
        helper.make_node("Gemm", ["terms", "slopes", "constants"], ["free"]),
        helper.make_node("Clip", ["free", "minus_one", "one"], [OUTPUT_NAME]),
    ]
    model = graph_of(nodes, _constants(table, box, nominal), "reference", (FEATURES, len(table)))
    return policy_file(
        model, bench, "reference", PARAMETER_NAMES, seen * nominal, wanted, provenance, ranges, kept.gain
    )


def _constants(table: Floats, box: Box, nominal: Floats) -> dict[str, Floats]:
    """Scaling of the features over their ranges, the factors of each term, and the table."""
    low, high = (np.log(np.array(end) * nominal) for end in box)
    width = np.where(high > low, high - low, np.inf)  # 0 for a parameter that is known
    one, pairs = np.eye(FEATURES), np.array(PRODUCTS)
    return {
        "scale": np.diag(2.0 / width),
        "middle": -((low + high) / width)[None],
        "minus_one": np.array(-1.0),
        "one": np.array(1.0),
        "first": np.hstack([one, one[:, pairs[:, 0]]]),
        "no_first": np.zeros((1, FEATURES + len(PRODUCTS))),
        "second": np.hstack([0.0 * one, one[:, pairs[:, 1]]]),
        "no_second": np.repeat([[1.0, 0.0]], [FEATURES, len(PRODUCTS)], axis=1),
        "slopes": np.ascontiguousarray(table[:, 1:].T),
        "constants": table[:, :1].T.copy(),
    }


def read_sequence(text: str, bench: Bench) -> tuple[Floats, str]:
    """The currents that a text or a file names [A], shape (horizon,), and what they are in words.

    Args:
        text: as :func:`emb_bench.excitation.reference.parse_excitation` reads it, or a file of ``emb-design -o``,
            ``.csv``.
        bench: its sample time, horizon and limits.

    Raises:
        UsageError: there is no such excitation or file, it is for another bench, or it is a feedback law.
    """
    if Path(text).suffix == ".csv":
        from emb_bench.design.report import read_design  # scipy takes its time

        return read_design(Path(text), bench)
    excited = parse_excitation(text, bench)
    if excited.currents is None:
        raise UsageError(f"{excited.name} is a feedback law: expected an excitation that is a sequence of currents")
    return excited.currents, excited.text


def sequence_file(currents: Floats, what: str, bench: Bench) -> tuple[bytes, float]:
    """The file of a sequence, and its largest difference as a part of the limit of the current.

    Args:
        currents: shape (horizon,) [A].
        what: for the provenance.
        bench: that they are for.

    Raises:
        PolicyRefusedError: the file would differ from the sequence.
    """
    last, t_s = len(currents) - 1, bench.timing.sample_time
    constants: dict[str, NDArray[Any]] = {
        "currents": currents.astype(np.float32),
        "time_index": np.array([2]),
        "rate": np.array(1.0 / t_s, np.float32),
        "begin": np.array(0),
        "end": np.array(last),
    }
    nodes = [
        helper.make_node("Gather", [INPUT_NAME, "time_index"], ["time"], axis=1),
        helper.make_node("Mul", ["time", "rate"], ["step"]),
        helper.make_node("Round", ["step"], ["whole"]),
        helper.make_node("Cast", ["whole"], ["number"], to=TensorProto.INT64),
        helper.make_node("Clip", ["number", "begin", "end"], ["place"]),
        helper.make_node("Gather", ["currents", "place"], [OUTPUT_NAME], axis=0),
    ]
    model = graph_of(nodes, constants, "current", (len(SAMPLE), 1))
    seen = np.zeros((len(currents), len(SAMPLE)))
    seen[:, 2] = t_s * np.arange(len(currents))
    return policy_file(model, bench, "current", SAMPLE, seen, currents[:, None], {"sequence": what})
