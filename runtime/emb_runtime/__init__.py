"""Everything that is installed on the bench computer: frames, 1 kHz loop, guard, recorder, policy."""

import os

# ONNX Runtime's Linux wheels report to their maker, from another thread, unless told not to before they are
# imported: not beside a control loop, and not from a bench computer.
os.environ["ORT_DISABLE_TELEMETRY"] = "1"

if os.environ.get("EMB_CORE") == "compiled":  # in every command, for tests and measurements
    from emb_runtime.system import compiled_core

    compiled_core.take_or_end()
