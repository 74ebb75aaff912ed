"""Rules for the modules that are compiled, because mypyc makes something else of what breaks them."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tools.compile_core import MODULES

RUNTIME = Path(__file__).parents[2] / "runtime" / "emb_runtime"


def tree_of(module: str) -> ast.Module:
    return ast.parse(RUNTIME.joinpath(*module.split(".")).with_suffix(".py").read_text(encoding="utf-8"))


@pytest.mark.parametrize("module", MODULES)
def test_no_property_is_cached(module: str) -> None:
    """It would be computed anew each time."""
    assert not [
        node for node in ast.walk(tree_of(module)) if isinstance(node, ast.Name) and node.id == "cached_property"
    ]


@pytest.mark.parametrize("module", MODULES)
def test_no_function_catches_two_exceptions_under_one_name(module: str) -> None:
    """The name has the type of the first: any other exception would become a TypeError, raised from the handler."""
    for function in ast.walk(tree_of(module)):
        if isinstance(function, ast.FunctionDef):
            names = [node.name for node in ast.walk(function) if isinstance(node, ast.ExceptHandler) and node.name]
            assert len(names) == len(set(names)), f"{module}.{function.name}"
