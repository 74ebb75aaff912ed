"""The contract of a policy: what its graph computes from what, and the benches that it was made for.

It travels as JSON with full precision in the ONNX metadata under :data:`CONTRACT_KEY`. A file is of unknown origin:
msgspec checks every key, type and value.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from emb_runtime.config.bench import PARAMETER_NAMES, Bench, Limits
from emb_runtime.config.typed import Positive, excerpt
from emb_runtime.errors import PolicyRefusedError

CONTRACT_KEY = "emb.contract"  # Key of the contract in the ONNX ``metadata_props``
SCHEMA: Literal[4] = 4
MAX_JSON_CHARACTERS = 1_000_000
MIN_VECTORS = 32
MAX_VECTORS = 4096
MAX_WIDTH = 64  # Numbers that a graph takes or gives
VECTOR_TOLERANCE = 1e-5
"""Largest difference of a replayed test vector from the recorded one, as a part of the output's limit."""
ROUNDING = 1e-6  # Relative: single precision in the policy may pass the greatest output by so much

SAMPLE = ("angle", "velocity", "time")  # Measured [rad, rad/s], and since the experiment began [s]
DEVIATIONS = tuple(f"{name}_deviation" for name in PARAMETER_NAMES)
INPUTS = (SAMPLE, (*SAMPLE, *PARAMETER_NAMES, *DEVIATIONS))
"""Inputs that a graph may have. Parameters are the running estimate, in SI units."""
UNITS = {"current": "A", "speed": "rad/s"}
"""Unit of the one output, by the kind of the graph."""

Name = Annotated[str, Meta(pattern=r"^[ -~]{1,120}\Z")]
Text = Annotated[str, Meta(pattern=r"^[ -~]{1,500}\Z")]
Numbers = Annotated[tuple[float, ...], Meta(min_length=1, max_length=MAX_WIDTH)]


class Vector(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Numbers of one evaluation, in the order of the graph."""

    inputs: Numbers
    outputs: Numbers


class PolicyLimits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Limits of the bench that a policy was made for."""

    current: Positive  # Both signs [A]; the largest current that the policy may ask for
    angle: tuple[float, float]  # Lowest and highest [rad]
    velocity: Positive  # Both signs [rad/s]


class Contract(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Everything that must fit before a policy may drive a bench.

    A graph of the kind ``current`` gives a current [A], one of the kind ``speed`` a target speed [rad/s], which the
    runtime's speed loop follows.
    """

    schema: Literal[4] = SCHEMA
    kind: Literal["current", "speed"]
    inputs: Annotated[tuple[str, ...], Meta(max_length=MAX_WIDTH)]
    limits: PolicyLimits
    sample_time: Positive  # [s]
    horizon: Annotated[int, Meta(ge=1, le=1_000_000)]  # Samples in one experiment
    vectors: Annotated[tuple[Vector, ...], Meta(min_length=MIN_VECTORS, max_length=MAX_VECTORS)]
    ranges: dict[Literal["k_m", "k_1", "T_c", "f_v"], tuple[Positive, Positive]] = {}
    """Lowest and highest value of each parameter that it was made for, SI units; empty for any."""
    velocity: Literal["sensor", "observer"] = "sensor"  # Origin of the velocity of the bench that it was made for
    gain: Annotated[float, Meta(gt=0.0, le=1.0)] = 1.0  # Of the speed loop
    provenance: dict[Name, Text | int | float] = {}

    def __post_init__(self) -> None:
        if self.inputs not in INPUTS:
            expected = " or ".join(f"[{', '.join(names)}]" for names in INPUTS)
            raise ValueError(f"inputs: expected {expected}, got {excerpt(self.inputs)}")
        for name, (low, high) in (("limits.angle", self.limits.angle), *self.ranges.items()):
            if not low <= high:
                raise ValueError(f"{name}: expected a lower bound first")
        for i, vector in enumerate(self.vectors):
            if (len(vector.inputs), len(vector.outputs)) != (len(self.inputs), 1):
                given = f"{len(vector.inputs)} and {len(vector.outputs)}"
                raise ValueError(f"vectors[{i}]: expected {len(self.inputs)} inputs and one {self.kind}, got {given}")
            # This way round, NaN is refused.
            if not all(abs(output) <= self.greatest * (1.0 + ROUNDING) for output in vector.outputs):
                raise ValueError(f"vectors[{i}]: expected outputs within ±{self.greatest:g}")

    @property
    def greatest(self) -> float:
        """Greatest output of the graph, both signs, but for its rounding."""
        return greatest_output(self.kind, self.limits)

    def to_json(self) -> str:
        """The contract as JSON; floats keep their full precision."""
        return msgspec.json.encode(self, order="sorted").decode()

    def bench_problem(self, bench: Bench) -> str:
        """Key of a bench that a policy cannot drive, and both values; "" if it can."""
        of_bench, limits = bench.limits, self.limits
        if self.sample_time != bench.timing.sample_time:
            return f"timing.sample_time is {bench.timing.sample_time!r} s, the policy has {self.sample_time!r} s"
        # A narrower bench is what shield and clip hold; a wider one would be driven as it never was before.
        if not of_bench.current <= limits.current:
            return f"limits.current is {of_bench.current!r} A, the policy has {limits.current!r} A at most"
        if not limits.angle[0] <= of_bench.angle[0] < of_bench.angle[1] <= limits.angle[1]:
            return f"limits.angle is {list(of_bench.angle)} rad, the policy has {list(limits.angle)} rad at most"
        if not of_bench.velocity <= limits.velocity:
            return f"limits.velocity is {of_bench.velocity!r} rad/s, the policy has {limits.velocity!r} rad/s at most"
        return ""

    def warnings(self, bench: Bench) -> list[str]:
        """Differences of a bench from those that the policy was made for, with which it may drive all the same."""
        found = []
        if self.horizon != bench.timing.horizon:
            found.append(f"horizon of {bench.timing.horizon} samples, made for {self.horizon}")
        if self.velocity != bench.sensors.velocity:
            found.append(f"velocity by {bench.sensors.velocity}, made for one by {self.velocity}")
        box = bench.range_set(bench.prior)
        for name, (low, high) in self.ranges.items():
            lowest, highest = getattr(box.low, name), getattr(box.high, name)
            if lowest < low or highest > high:
                found.append(f"{name} in {lowest:g} to {highest:g}, made for {low:g} to {high:g}")
        return found


def greatest_output(kind: str, limits: PolicyLimits | Limits) -> float:
    """Limit of the one output of a graph, both signs: of a current [A], or of a target speed [rad/s]."""
    return limits.current if kind == "current" else limits.velocity


def read_contract(text: str) -> Contract:
    """Read a contract of unknown origin; PolicyRefusedError if something is wrong with it."""
    if len(text) > MAX_JSON_CHARACTERS:
        raise PolicyRefusedError(f"contract: expected at most {MAX_JSON_CHARACTERS} characters, got {len(text)}")
    try:
        return msgspec.json.decode(text, type=Contract)
    except (msgspec.MsgspecError, RecursionError) as err:
        raise PolicyRefusedError(f"contract: {excerpt(str(err))}: export the policy anew") from err
