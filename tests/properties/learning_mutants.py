"""Learners with one pad, check or rule left out: the search must find that each is unsound."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, NamedTuple

import tests.properties.learning_search as search_module
from emb_bench.compiled import source_module


class Mutant(NamedTuple):
    """A change of the source of the learner, and where it must show."""

    says: str
    old: str
    new: str
    flow: bool = True
    quiet: bool = False  # With sensors so good that their pads do not hide what is left out
    declared: bool = False  # With a declared error of the model and of the current


_MEAN = "2.0 * assumptions.angle_noise * assumptions.viscous * state[HIGH + 3]"
MUTANTS: dict[str, Mutant] = {
    "bend": Mutant(
        "three angle errors in a bend, not four", "4.0 * assumptions.angle_noise", "3.0 * assumptions.angle_noise"
    ),
    "spring": Mutant(
        "no pad for the spring at an angle that errs",
        "spring = assumptions.angle_noise * assumptions.spring * state[HIGH + 1]",
        "spring = 0.0",
        flow=False,
    ),
    "mean": Mutant("no pad for the mean angles of viscous friction", f"/ nt + {_MEAN}", "/ nt", flow=False),
    "rise": Mutant(
        "one velocity error in a rise, not two", "2.0 * assumptions.velocity_noise", "1.0 * assumptions.velocity_noise"
    ),
    "velocity": Mutant(
        "one angle error in a velocity, not two",
        "pad = 2.0 * assumptions.angle_noise / nt",
        "pad = 1.0 * assumptions.angle_noise / nt",
    ),
    "model error": Mutant("no pad for the model's error", "spring + assumptions.model_error", "spring", declared=True),
    "current error": Mutant(
        "no pad for the current's error",
        " + assumptions.motor * state[HIGH] * assumptions.current_error",
        "",
        declared=True,
    ),
    "trapezoids": Mutant(
        "no pad for the trapezoids of a squeezed angle", "(nt / 12.0 * peak + ", "(0.0 * peak + ", quiet=True
    ),
    "contact": Mutant("no pad for contact within a period", "assumptions.speed / 8.0", "0.0", quiet=True),
    "sums": Mutant("no pad for the trapezoids of their sums", "assumptions.speed / 6.0", "0.0", quiet=True),
    "angles": Mutant("no pad for the trapezoids of the angle", "t * t / 6.0 * peak", "0.0 * peak", quiet=True),
    "flow": Mutant("no pad for the flow within a period", "pad = 0.5 * t * t * jerk", "pad = 0.0 * jerk", quiet=True),
    "direction": Mutant(
        "a direction that is certain at the sample, not throughout the period",
        "(not flow or v",
        "(True or v",
        quiet=True,
    ),
    "lost": Mutant("a segment that goes on after a lost sample", "state[FOLLOWS] = state[LENGTH] = 0.0", "pass"),
    "rest": Mutant("no brake that comes to rest", "lightest * vh), 0.0)", "lightest * vh), -9e9)", quiet=True),
    "reversal": Mutant("no friction that pushes", "t * (drive + friction))", "t * drive)", flow=False),
    "ellipsoid": Mutant("an ellipsoid scaled too small", "1.0 + hh * taken / m", "1.0 + 0.9 * hh * taken / m"),
    "corner": Mutant(
        "an ellipsoid that leaves the corners of the box out",
        "state[SHAPE + diagonal] = state[UNKNOWNS] *",
        "state[SHAPE + diagonal] =",
    ),
}


def broken(mutant: Mutant, episodes: Callable[..., None]) -> Any:
    """The episodes of the search with a learner that is changed."""
    original = source_module("emb_runtime.learning.bounded")
    source = Path(str(original.__file__)).read_text(encoding="utf-8")
    assert mutant.old in source, mutant.old
    changed = ModuleType(f"{original.__name__}_changed")
    sys.modules[changed.__name__] = changed
    exec(compile(source.replace(mutant.old, mutant.new), str(original.__file__), "exec"), changed.__dict__)
    episode = _rewired(search_module.episode, {"hear": changed.hear, "lose": changed.lose})
    return _rewired(episodes, {"episode": episode})


def _rewired(function: Any, names: dict[str, Any]) -> Any:
    """A copy of a function for which some global names mean something else."""
    copy = FunctionType(function.__code__, {**function.__globals__, **names}, function.__name__, function.__defaults__)
    copy.__module__, copy.__qualname__ = function.__module__, function.__qualname__
    return copy
