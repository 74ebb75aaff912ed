"""An identified brake as an FMU: FMI 3.0, co-simulation, with its C and, where there is a compiler, a library of it.

There is no model exchange: its importer integrates, and would step over a standstill that the exact solution holds.
"""

from __future__ import annotations

import hashlib
import io
import os
import platform
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from emb_bench.export.c_source import OUTPUTS, c_source, part
from emb_bench.export.identified import START, Identified

NAME = "brake"  # Identifier of the model, and of its library
TIME = "time"
_BASE: Mapping[str, Mapping[str, int]] = {
    "N": {"kg": 1, "m": 1, "s": -2},
    **{name: {name: 1} for name in ("kg", "m", "s", "A", "rad")},
    "1": {},
}
_FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared", "-s")  # rounded as the bench rounds


def fmu(found: Identified) -> tuple[bytes, str]:
    """The FMU, and its description in words: with a library, or the reason without one."""
    source = c_source(found)
    token = hashlib.sha256(source.encode()).hexdigest()
    inside = {
        "modelDescription.xml": _text(description(found, token)),
        "sources/buildDescription.xml": _text(_build_description()),
        "sources/brake.c": source.encode(),
        "sources/fmi3.c": _glue(found, token).encode(),
    }
    place = f"binaries/{platform.machine()}-linux"
    library, reason = _library(inside)
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        for name, content in (inside | ({f"{place}/{NAME}.so": library} if library else {})).items():
            archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
    return made.getvalue(), f"an FMU ({f'FMI 3.0, co-simulation; {place}' if library else f'sources alone: {reason}'})"


def description(found: Identified, token: str) -> Element:
    """The model description: each parameter with its estimate and its interval, one input, four outputs."""
    parameters = found.parameters()
    root = Element(
        "fmiModelDescription",
        fmiVersion="3.0",
        modelName=NAME,
        instantiationToken=token,
        description=f"electromechanical brake; parameters: {found.source}",
        generationTool="emb-excite",
    )
    can = ("canHandleVariableCommunicationStepSize", "canGetAndSetFMUState")
    SubElement(root, "CoSimulation", {"modelIdentifier": NAME, **dict.fromkeys(can, "true")})
    units = SubElement(root, "UnitDefinitions")
    for unit in dict.fromkeys(["A", "s", *(one.unit for one in parameters), *(unit for unit, _ in OUTPUTS.values())]):
        SubElement(SubElement(units, "Unit", name=unit), "BaseUnit", _base_unit(unit))
    SubElement(root, "DefaultExperiment", startTime="0", stepSize=repr(found.bench.timing.sample_time))
    variables = SubElement(root, "ModelVariables")

    def add(name: str, unit: str, about: str, causality: str, variability: str, **more: str) -> str:
        reference = str(len(variables))
        shown = {"name": name, "valueReference": reference, "description": about, "unit": unit}
        SubElement(variables, "Float64", shown, causality=causality, variability=variability, **more)
        return reference

    add(TIME, "s", "time", "independent", "continuous")
    for one in parameters:
        kind = "fixed" if one.name in START else "tunable"
        ends = {"start": repr(one.value), "min": repr(one.least), "max": repr(one.greatest)}
        add(one.name, one.unit, f"{one.about}; {one.uncertainty}", "parameter", kind, **ends)
    add("current", "A", "current of the motor, held over a step", "input", "continuous", start="0")
    outputs = [add(name, unit, about, "output", "continuous") for name, (unit, about) in OUTPUTS.items()]
    structure = SubElement(root, "ModelStructure")
    for tag in ("Output", "InitialUnknown"):
        for reference in outputs:
            SubElement(structure, tag, valueReference=reference)
    return root


def _base_unit(unit: str) -> dict[str, str]:
    """Exponents of the SI base units of a unit such as ``N.m.s/rad``."""
    found: dict[str, int] = {}
    above, _, below = unit.partition("/")
    for sign, factors in ((1, above), (-1, below)):
        for name, power in re.findall(r"([A-Za-z]+)(\d?)", factors):
            for base, exponent in _BASE[name].items():
                found[base] = found.get(base, 0) + sign * int(power or 1) * exponent
    return {base: str(exponent) for base, exponent in found.items() if exponent}


def _build_description() -> Element:
    root = Element("fmiBuildDescription", fmiVersion="3.0")
    build = SubElement(root, "BuildConfiguration", modelIdentifier=NAME)
    files = SubElement(build, "SourceFileSet", language="C99", compilerOptions="-ffp-contract=off")
    SubElement(files, "SourceFile", name="fmi3.c")  # which includes brake.c
    SubElement(build, "Library", name="m")
    return root


def _glue(found: Identified, token: str) -> str:
    """The functions of FMI around the C of the brake."""
    numbers = {"current": str(len(found.parameters()) + 1), "token": token}
    return re.sub(r"@(\w+)@", lambda mark: numbers[mark[1]], part("fmi3.c"))


def _text(root: Element) -> bytes:
    ElementTree.indent(root)
    text: bytes = ElementTree.tostring(root, encoding="UTF-8", xml_declaration=True)
    return text + b"\n"


def _library(inside: Mapping[str, bytes]) -> tuple[bytes, str]:
    """The compiled sources; nothing, and the reason, where they cannot be compiled."""
    compiler = shutil.which(os.environ.get("CC") or "cc") or shutil.which("gcc")
    if compiler is None or sys.platform != "linux":
        return b"", "there is no C compiler here (gcc and libc6-dev)" if compiler is None else "this is not Linux"
    try:
        with TemporaryDirectory() as folder:
            for name, content in inside.items():
                (Path(folder) / Path(name).name).write_bytes(content)
            command = [compiler, *_FLAGS, "-o", "brake.so", "fmi3.c", "-lm"]
            made = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
            if made.returncode:
                return b"", f"{compiler} failed: {next(iter(made.stderr.splitlines()), f'exit code {made.returncode}')}"
            return (Path(folder) / "brake.so").read_bytes(), ""
    except OSError as err:  # no place for temporary files, or no program
        return b"", f"it was not compiled: {err.strerror}"
