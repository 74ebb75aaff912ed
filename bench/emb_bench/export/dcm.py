"""An identified brake as a calibration file: DCM 2.0, a scalar (``FESTWERT``) for each parameter."""

from __future__ import annotations

from emb_bench.export.identified import CHOSEN, Identified


def dcm(found: Identified) -> str:
    """The text of the file: the parameters of the brake, each with its 95 % interval in a comment."""
    lines = ["KONSERVIERUNG_FORMAT 2.0", "* Made by emb-excite", f"* parameters: {found.source}"]
    for one in (one for one in found.parameters() if one.name not in CHOSEN):
        lines += ["", f"FESTWERT {one.name}", f'   LANGNAME "{one.about}"', f'   EINHEIT_W "{one.unit}"']
        lines += [f"   WERT {one.value!r}", f"* {one.uncertainty}", "END"]
    return "\n".join([*lines, ""])
