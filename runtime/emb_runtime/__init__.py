"""Everything that is installed on the bench computer: frames, 1 kHz loop, guard, recorder, policy."""

import os

# ONNX Runtime's Linux wheels report to their maker, from a thread of their own, unless told not to before they are
# imported: not beside a control loop, and not from a bench computer.
os.environ["ORT_DISABLE_TELEMETRY"] = "1"
