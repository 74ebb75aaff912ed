"""Export of currents or a network to one ONNX file with its contract, and the check that both compute the same."""

from __future__ import annotations


def emb_export() -> int:
    """Currents or a network as a policy for emb-run; imported after the first handler of a Ctrl-C."""
    from emb_runtime.system.entry import run_command  # this package is also a library

    return run_command("emb_export.export", "emb-export: interrupted, nothing written")
