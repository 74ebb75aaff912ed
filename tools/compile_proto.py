"""Compiles the messages of a log's topics, ``emb.proto``, into ``emb.binpb``: a FileDescriptorSet with its comments.

    python -m tools.compile_proto

It needs grpcio-tools. The runtime reads the set and needs no generated code, whose version protobuf would check.
"""

from __future__ import annotations

import sys
from pathlib import Path

from grpc_tools import protoc

FOLDER = Path(__file__).parents[1] / "runtime" / "emb_runtime" / "log"


def compile_proto(output: Path) -> int:
    """Compile into a file; gives the compiler's exit code."""
    options = [f"--proto_path={FOLDER}", f"--descriptor_set_out={output}", "--include_source_info"]
    return int(protoc.main(["protoc", *options, "emb.proto"]))


if __name__ == "__main__":
    sys.exit(compile_proto(FOLDER / "emb.binpb"))
