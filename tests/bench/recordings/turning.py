"""A motor without a spring that others drove: exact between samples, so that its parameters are found again."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

J, K_M, T_C, F_V = 1e-4, 0.05, 0.012, 2e-4
T_S = 0.002  # [s]
MAP = """\
schema = 1
name = "a motor without a spring"
[file]
{file}
[timing]
{timing}
[signals.angle]
column = "angle"
unit = "rad"
noise = 1e-4
{angle}
[signals.velocity]
column = "velocity"
unit = "rad/s"
noise = 0.02
{velocity}
[signals.command]
column = "current"
unit = "A"
{command}
[machine]
window = 0.5
[machine.known]
J = 1e-4
k_m = 0.05
[machine.guess]
T_c = {T_c}
f_v = {f_v}
"""
TIMED = 'column = "t"'


def columns(seed: int = 1, periods: int = 1000, static: float = 1.0) -> dict[str, Floats]:
    """Time [s], angle [rad], velocity [rad/s] and commanded current [A], held from each sample to the next.

    At rest the friction is ``static`` times T_c.
    """
    rng, t = np.random.default_rng(seed), T_S * np.arange(periods)
    u = 1.1 * np.sin(5.0 * t) * (1.0 + 0.3 * np.sin(19.5 * t)) + 0.35 * np.sin(39.6 * t)
    motion, x, v = np.empty((periods, 2)), 0.0, 0.0
    for k, torque in enumerate((K_M * u).tolist()):
        motion[k], left = (x, v), T_S
        while left > 1e-15:
            sign = np.sign(v) or (np.sign(torque) if abs(torque) > static * T_C else 0.0)
            if sign == 0.0:
                break
            last, rate, h = (torque - sign * T_C) / F_V, F_V / J, left
            if v != 0.0 and last * sign < 0.0:
                h = min(left, float(np.log((v - last) / -last)) / rate)
            decay = float(np.exp(-rate * h))
            x, v = x + last * h + (v - last) * (1.0 - decay) / rate, last + (v - last) * decay if h == left else 0.0
            left -= h
    noisy = motion + rng.standard_normal(motion.shape) * (1e-4, 0.02)
    return {"t": t, "angle": noisy[:, 0], "velocity": noisy[:, 1], "current": u}


def map_text(text: Mapping[str, str] | None = None) -> str:
    """A map with some lines more, by the place where they belong."""
    usual = {"file": "", "timing": TIMED, "angle": "", "velocity": "", "command": "", "T_c": "0.02", "f_v": "1e-4"}
    return MAP.format(**(usual | dict(text or {})))


def csv_text(found: Mapping[str, Floats], delimiter: str = ",") -> str:
    """The columns as a CSV file."""
    rows = zip(*(column.tolist() for column in found.values()), strict=True)
    return "\n".join([delimiter.join(found), *(delimiter.join(f"{x:.10g}" for x in row) for row in rows)]) + "\n"


def put(
    folder: Path, content: str | bytes, text: Mapping[str, str] | None = None, name: str = "r.csv"
) -> tuple[Path, Path]:
    """A recording and its map."""
    (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    (folder / "map.toml").write_text(map_text(text))
    return folder / name, folder / "map.toml"
