"""Excitation of a step as a policy file: a sequence of currents within a window of angle and speed."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import onnx

from emb_bench.commission.records import Step
from emb_runtime.config.bench import Bench
from emb_runtime.policy.contract import CONTRACT_KEY, MIN_VECTORS, SAMPLE, Contract, PolicyLimits, Vector

GRAPH = """
<ir_version: 10, opset_import: ["" : 20]>
commissioning (float[1, 3] inputs) => (float[1, 1] outputs)
<
  float[1] lowest = {{{lowest}}}, float[1] highest = {{{highest}}}, float[1] fastest = {{{speed}}},
  float[1] slowest = {{-{speed}}}, float[1] least = {{{least}}}, float[1] most = {{{most}}}, float[1] zero = {{0}},
  float[1] rate = {{{rate}}},
  float[{count}] currents = {{{currents}}},
  int64[1] first = {{0}}, int64[1] second = {{1}}, int64[1] third = {{2}}, int64 begin = {{0}}, int64 last = {{{last}}}
>
{{
  angle = Gather <axis = 1> (inputs, first)
  velocity = Gather <axis = 1> (inputs, second)
  time = Gather <axis = 1> (inputs, third)
  step = Mul (time, rate)
  whole = Round (step)
  number = Cast <to = 7> (whole)
  place = Clip (number, begin, last)
  wanted = Gather <axis = 0> (currents, place)
  above = Greater (angle, highest)
  fast_up = Greater (velocity, fastest)
  no_more_up = Or (above, fast_up)
  upper = Where (no_more_up, zero, most)
  below = Less (angle, lowest)
  fast_down = Less (velocity, slowest)
  no_more_down = Or (below, fast_down)
  lower = Where (no_more_down, zero, least)
  raised = Max (wanted, lower)
  outputs = Min (raised, upper)
}}
"""
"""The current of the step, cut to zero on the side that leads out of the window."""


def policy_file(step: Step, bench: Bench) -> bytes:
    """The policy of a step, for a bench: its current, but none that drives the brake farther out of the window."""
    currents = np.asarray(step.currents, np.float32)
    limit, window = bench.limits.current, step.window
    text = GRAPH.format(
        lowest=window.lowest,
        highest=window.highest,
        speed=window.speed,
        rate=1.0 / bench.timing.sample_time,
        least=-limit,
        most=limit,
        count=len(currents),
        currents=_numbers(currents.tolist()),
        last=len(currents) - 1,
    )
    model = onnx.parser.parse_model(text)
    model.metadata_props.add(key=CONTRACT_KEY, value=_contract(currents.tolist(), step, bench).to_json())
    return model.SerializeToString()


def _numbers(values: Iterable[float]) -> str:
    return ", ".join(f"{value:.9g}" for value in values)  # nine digits tell single precision exactly


def _contract(currents: list[float], step: Step, bench: Bench) -> Contract:
    places = [k * (len(currents) - 1) // (MIN_VECTORS - 1) for k in range(MIN_VECTORS)]
    return Contract(
        kind="current",
        inputs=SAMPLE,
        limits=PolicyLimits(bench.limits.current, bench.limits.angle, bench.limits.velocity),
        sample_time=bench.timing.sample_time,
        horizon=bench.timing.horizon,
        vectors=tuple(Vector((0.0, 0.0, k * bench.timing.sample_time), (currents[k],)) for k in places),
        provenance={"commissioning": step.name},
    )
