"""A log and a contract that version 0.1.0 wrote are read, evaluated and decided again as that version did.

``v0_1/run.mcap`` is a run of the structured actor on the exact brake (``emb-run --iface sim:plant=exact,seed=9
--policy four-d-exact-affine.onnx``), ``v0_1/expected.json`` holds what ``emb-replay fim`` and ``estimate`` of that
version computed from it with ``--model exact``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emb_bench.cli.replay import main
from emb_bench.logs.log import read_log
from emb_runtime.policy.policy import load_policy

FOLDER = Path(__file__).parent / "v0_1"
RUN = FOLDER / "run.mcap"
EXPECTED: dict[str, Any] = json.loads((FOLDER / "expected.json").read_text(encoding="utf-8"))
ROUNDING = 1e-9


def document(capsys: pytest.CaptureFixture[str], command: str, *options: str) -> Any:
    assert main([command, str(RUN), "--model", "exact", "--json", *options]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("kind", ["physical", "weighted"])
def test_its_fisher_information_is_the_same(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    matrix = np.array(document(capsys, "fim")[kind]["matrix"])
    np.testing.assert_allclose(matrix, EXPECTED[kind], rtol=ROUNDING, atol=ROUNDING * np.abs(matrix).max())


def test_its_estimates_are_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    found = document(capsys, "estimate", "--systematic", "none")  # which 0.1 did not know
    assert found["misfit"]["chi2"] == pytest.approx(EXPECTED["chi2"], rel=ROUNDING)
    for name, expected in EXPECTED["parameters"].items():
        assert found["parameters"][name]["value"] == pytest.approx(expected["value"], rel=ROUNDING)
        assert found["parameters"][name]["interval_95"] == pytest.approx(expected["interval_95"], rel=ROUNDING)


def test_the_loop_decides_the_same_again(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["rerun", str(RUN)]) == 0
    assert "each of 501 decisions" in capsys.readouterr().out


def test_its_policy_is_accepted_for_its_bench() -> None:
    log = read_log(RUN)
    assert load_policy(log.attachments["policy.onnx"], log.bench).contract.provenance
