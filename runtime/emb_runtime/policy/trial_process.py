"""The process that tries a policy file: reads, loads and asks it, confined, and says whether it is refused.

``python -m emb_runtime.policy.trial_process DOCUMENT_FD``, started by :mod:`emb_runtime.policy.trial` and by nobody
else. It answers on standard output, one JSON object per line: ``ready``, then ``accepted`` or ``refused``.
"""

from __future__ import annotations

import base64
import json
import os
import pickle
import sys

from emb_runtime.errors import EmbError
from emb_runtime.system.confinement import confine, end_with


def main(arguments: list[str]) -> int:
    """Try one policy. Returns the exit status."""
    with os.fdopen(int(arguments[0]), "rb") as memory:
        memory.seek(0)
        document = json.loads(memory.read())
    end_with(document["parent"])
    from emb_runtime.policy.policy import load_policy  # takes its time: ONNX Runtime

    bench = pickle.loads(base64.b64decode(document["bench"]))  # from the parent, which made it
    data = base64.b64decode(document["policy"])
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)  # what a library has to say when it fails is not for the user
    confine(document["memory"], document["seconds"])
    _say({"ready": True})
    try:
        load_policy(data, bench)
    except EmbError as err:
        _say({"refused": str(err)})
    except MemoryError:
        _say({"refused": f"loading it takes more than {document['memory'] >> 20} MiB of memory"})
    else:
        _say({"accepted": True})
    return 0


def _say(answer: dict[str, object]) -> None:
    os.write(1, json.dumps(answer).encode() + b"\n")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
