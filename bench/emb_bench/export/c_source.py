"""An identified brake as C that depends on nothing but the C library: one file for simulators and firmware.

The plant is that of ``simulate``: the exact solution between events, or for a brake with features the same Runge-Kutta
pair with the same steps, without the sensitivities. The C of each is in ``c/``; what is generated are the parameters.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable
from importlib.resources import files

from emb_bench.export.identified import Identified

OUTPUTS = {
    "angle": ("rad", "angle of the motor"),
    "velocity": ("rad/s", "velocity of the motor"),
    "clamping_force": ("N", "clamping force"),
    "friction_torque": ("N.m", "friction torque, positive against a positive velocity"),
}
"""Members of the struct that are outputs, with unit and description."""


def part(name: str) -> str:
    """A part of the C, as it is in ``c/``."""
    return files("emb_bench.export").joinpath("c", name).read_text(encoding="utf-8")


def c_source(found: Identified) -> str:
    """The C of a brake: a struct, and functions that start it and step it."""
    parameters = found.parameters()
    about = textwrap.fill(
        f"Made by emb-excite; parameters: {found.source}. Double precision, SI units; a step solves sticking and "
        "contact exactly. Where this file is only declared: #define BRAKE_DECLARATIONS_ONLY.",
        width=112,
    )
    made = {
        "fields": f"  double {_listed(one.name for one in parameters)};",
        "values": "\n".join(
            f"  b->{one.name} = {one.value!r}; /* [{one.unit}] {one.about}; {one.uncertainty} */" for one in parameters
        ),
        "least": _listed(f"{one.least:g}" for one in parameters),
        "greatest": _listed(f"{one.greatest:g}" for one in parameters),
    }
    parts = "".join(map(part, ("head.c", "exact.c" if found.plain else "extended.c", "tail.c")))
    code = re.sub(r"@(\w+)@", lambda mark: made[mark[1]], parts)
    return f"/* {about} */\n{code}"


def _listed(items: Iterable[str]) -> str:
    return textwrap.fill(", ".join(items).replace("e+", "e"), 104, subsequent_indent="      ")
