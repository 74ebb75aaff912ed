"""The process that tries a policy file: reads, loads and asks it, confined, and says whether it is refused.

``python -m emb_runtime.policy.trial_process DOCUMENT_FD``, started by :mod:`emb_runtime.policy.trial` and by nobody
else. It answers on standard output, one JSON object per line: ``ready`` with the processor time that the file may take
[s], then ``accepted``, or ``refused`` with the reason.
"""

from __future__ import annotations

import base64
import os
import pickle
import sys
import time

from emb_runtime.errors import EmbError
from emb_runtime.system import child_process
from emb_runtime.system.child_process import confine, end_with


def main(arguments: list[str]) -> int:
    """Try one policy. Returns the exit status."""
    document = child_process.read_document(int(arguments[0]))
    end_with(document["parent"])
    import onnxruntime  # noqa: F401  # so that it is part of the time that is measured

    from emb_runtime.policy.policy import load_policy

    bench = pickle.loads(base64.b64decode(document["bench"]))  # from the parent, which made it
    data = base64.b64decode(document["policy"])
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)  # what a library has to say when it fails is not for the user
    seconds = document["multiple"] * time.process_time()
    confine(document["memory"], seconds)
    child_process.answer({"ready": seconds})
    try:
        load_policy(data, bench)
    except EmbError as err:
        child_process.answer({"refused": str(err)})
    except MemoryError:
        child_process.answer({"refused": f"loading it takes more than {document['memory'] >> 20} MiB of memory"})
    else:
        child_process.answer({"accepted": True})
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
