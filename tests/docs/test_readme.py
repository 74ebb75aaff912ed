"""The example of the README runs; what several files say of the project is the same in each."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"


@pytest.mark.slow
def test_the_example_of_the_readme_runs(tmp_path: Path) -> None:
    example, _ = re.findall(r"^```python\n(.*?)^```$", README.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", example], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    reason, bound, fitted, planned, currents = done.stdout.split("\n", 4)
    fits, f_v = fitted.split()
    assert (reason, fits) == ("DONE", "True")
    assert abs(float(f_v) / 3e-5 - 1.0) < 5.0 * float(bound) < 1e-4
    assert planned.endswith(" (20, 4, 2)")
    assert len(currents.strip("[]\n").split()) > 100 or "..." in currents


def test_pre_commit_runs_what_make_lint_runs() -> None:
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))["repos"][0]["hooks"]
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    (lint,) = re.findall(r"^lint:.*\n((?:\t.*\n)+)", makefile, re.MULTILINE)
    ours = [hook["entry"].removeprefix(".venv/bin/").replace(" --force-exclude", "").split() for hook in hooks]
    theirs = [line.strip().removeprefix("$(BIN)/").removesuffix(" .").split() for line in lint.splitlines()]
    assert ours == theirs


def test_the_citation_is_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert {citation[key] for key in ("title", "version", "license")} == {
        project[k] for k in ("name", "version", "license")
    }


def test_the_readme_names_this_version_its_python_and_its_license() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    first = project["requires-python"].removeprefix(">=").partition(",")[0]
    (version, python, licence) = re.findall(
        r"^Version (\S+) · Python (\S+) to \S+ · Linux · (\S+)$", README.read_text(encoding="utf-8"), re.MULTILINE
    )[0]
    assert (version, python, licence) == (project["version"], first, project["license"])
