"""The bench file of an imported recording: a machine for analysis, from its map and its samples."""

from __future__ import annotations

import json

from emb_bench.recordings.map_file import RecordingMap
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.config.plants import IMPORTED_PLANT
from emb_runtime.config.systematic import Systematic


def bench_text(
    wanted: RecordingMap,
    sample_time: float,
    horizon: int,
    noise: tuple[float, float],
    reach: tuple[float, float, float, float],
    bandwidth: float,
) -> str:
    """Text of the bench file.

    Args:
        wanted: the map.
        sample_time: [s].
        horizon: periods.
        noise: standard deviations of angle [rad] and velocity [rad/s].
        reach: lowest and highest angle [rad], largest speed [rad/s], largest current [A].
        bandwidth: of the observer that made the velocity [rad/s]; 0 if it was measured.
    """
    low, high, speed, current = reach
    slack = 0.5 * (high - low) + 1.0
    machine = wanted.machine
    own = {"J": 1.0, "gamma": 1.0, "k_m": 1.0, "k_1": 0.0, "T_c": 1.0, "f_v": 1.0} | machine.parameters
    by_direction = [name for name in machine.unknown if name not in own]
    lines = [
        "# A machine for the analysis of recordings: nothing is driven with it.",
        "schema = 1",
        f"name = {_text(wanted.name)}",
        "",
        "[machine]",
        f"unknown = {_list(machine.unknown)}",
        f"nuisances = {_list(machine.nuisances)}",
        *([f"window = {machine.window!r}  # s"] if machine.window else []),
        f"between = {_text(wanted.between)}",
        *([f"travel = {machine.travel!r}  # m/rad"] if machine.travel else []),
        "",
        "[machine.units]",
        *(f"{key} = {_text(unit)}" for key, unit in wanted.shown.items()),
        "",
        "[brake]",
        *(f"{key} = {own[key]!r}" for key in ("J", "gamma", *PARAMETER_NAMES)),
        "",
        "[limits]",
        f"current = {2.0 * current + 1e-6!r}",
        f"angle = [{min(low - slack, -1.0)!r}, {max(high + slack, 1.0)!r}]",
        f"velocity = {3.0 * speed + 1.0!r}",
        "",
        "[noise]",
        f"angle = {noise[0]!r}",
        f"velocity = {noise[1]!r}",
        "",
        "[timing]",
        f"sample_time = {sample_time!r}",
        f"horizon = {horizon}",
        "",
        "[systematic]  # what a map can say of a bench is exact",
        *(f"{key} = 0.0" for key in Systematic.__dataclass_fields__),
        "",
        f"[plants.{IMPORTED_PLANT}]",
        *([f"observer_bandwidth = {bandwidth!r}"] if bandwidth else []),
        *(f"{key} = 0.0" for key in by_direction),
    ]
    return "\n".join(lines) + "\n"


def _text(value: str) -> str:
    return json.dumps(value, ensure_ascii=False)  # a JSON string of printable characters is a TOML string


def _list(values: tuple[str, ...]) -> str:
    return json.dumps(list(values))
