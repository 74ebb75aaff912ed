"""Compiles each ``.proto`` file of the runtime into a FileDescriptorSet with its comments, beside it: a ``.binpb``.

    python -m tools.compile_proto

It needs grpcio-tools. The runtime reads the sets and needs no generated code, whose version protobuf would check.
"""

from __future__ import annotations

import sys
from pathlib import Path

from grpc_tools import protoc

RUNTIME = Path(__file__).parents[1] / "runtime" / "emb_runtime"
SOURCES = (RUNTIME / "log" / "emb.proto", RUNTIME / "policy" / "onnx_part.proto")


def compile_proto(source: Path, output: Path) -> int:
    """Compile into a file; gives the compiler's exit code."""
    options = [f"--proto_path={source.parent}", f"--descriptor_set_out={output}", "--include_source_info"]
    return int(protoc.main(["protoc", *options, source.name]))


if __name__ == "__main__":
    sys.exit(max(compile_proto(source, source.with_suffix(".binpb")) for source in SOURCES))
