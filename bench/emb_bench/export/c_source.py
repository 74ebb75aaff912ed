"""An identified brake as C that depends on nothing but the C library: one file for simulators and firmware.

The plant is that of ``simulate``: the exact solution between events, or for a brake with features the same Runge-Kutta
pair with the same steps, without the sensitivities. The C of each is in ``c/``; what is generated are the parameters.
"""

from __future__ import annotations

import textwrap
from importlib.resources import files

from emb_bench.export.identified import Identified

OUTPUTS = {
    "angle": ("rad", "angle of the motor"),
    "velocity": ("rad/s", "velocity of the motor"),
    "clamping_force": ("N", "clamping force"),
    "friction_torque": ("N.m", "friction torque, positive against a positive velocity"),
}
"""Members of the struct that are outputs, with their units and what they are."""


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
    names = textwrap.fill(", ".join(one.name for one in parameters), 104, subsequent_indent="      ")
    values = "\n".join(
        f"  b->{one.name} = {one.value!r}; /* [{one.unit}] {one.about}; {one.known} */" for one in parameters
    )
    plant = part("exact.c" if found.plain else "extended.c")
    head = part("head.c").replace("@fields@", f"  double {names};")
    return f"/* {about} */\n{head}{plant}{part('tail.c').replace('@values@', values)}"
