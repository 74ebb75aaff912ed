"""Fails unless a wheel holds the tracked files of the packages, and completions, alone: ``package_files.py WHEEL``."""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from pathlib import Path

PACKAGES = ("runtime/emb_runtime", "bench/emb_bench", "train/emb_train", "export/emb_export")

SHARED = {"completions/bash": "share/bash-completion/completions", "completions/zsh": "share/zsh/site-functions"}
CORE = "emb_runtime/native"


def complaint(wheel: Path) -> str | None:
    """Names the files that are missing or stray in the wheel; None if there are none."""
    tracked = subprocess.run(["git", "ls-files", *PACKAGES], capture_output=True, text=True, check=True).stdout.split()
    expected = {name.split("/", 1)[1] for name in tracked}
    for folder, place in SHARED.items():
        expected |= {f"{place}/{path.name}" for path in Path(folder).iterdir()}
    with zipfile.ZipFile(wheel) as archive:
        found = {name.split(".data/data/")[-1] for name in archive.namelist() if ".dist-info/" not in name}
        if not wheel.name.endswith("-none-any.whl"):  # the compiled core is made with it
            manifest = json.loads(archive.read(f"{CORE}/manifest.json"))
            expected |= {f"{CORE}/manifest.json", *(f"{CORE}/{name}" for name in manifest["files"].values())}
    if found == expected:
        return None
    return f"{wheel}: stray {sorted(found - expected)}, missing {sorted(expected - found)}"


if __name__ == "__main__":
    sys.exit(complaint(Path(sys.argv[1])))
