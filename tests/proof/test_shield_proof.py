"""The checker of the argument for the shield: it accepts the laws that run, and no broken one."""

from __future__ import annotations

import ast
import inspect
import json
import linecache
import math
import struct
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from random import Random
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import emb_runtime.safety.shield as shield_module
import emb_runtime.safety.shield_design as envelope_module
import proof.cases as cases_module
import proof.exhaustive as exhaustive_module
import proof.extensions as extensions_module
import proof.safety as safety_module
import proof.successors as successors_module
import proof.windows as windows_module
from emb_bench.brake.euler import step as euler_step
from emb_runtime.config.bench import BrakeParameters, Ranges
from proof.__main__ import main
from proof.boxes import cover, slack_of
from proof.cases import Case, case_of, reserve
from proof.exhaustive import damped_way, interval_law
from proof.intervals import Boxes, Interval
from proof.lemmas import BRAKING, judge, lemmas
from proof.safety import Thrown
from proof.symbolic_execution import lift, selection
from proof.terms import Facts, lifted_law, prove
from tests.benches import SENSOR_BENCH
from tests.laws import with_numbers
from tests.properties.shield_search import bench_with, damped

SHIPPED = case_of(SENSOR_BENCH)
LEMMAS = {lemma.key: lemma for lemma in BRAKING}
PROOFS = (successors_module, windows_module, safety_module, exhaustive_module, extensions_module)
MODULES = (envelope_module, shield_module, cases_module, *PROOFS)


def refused(key: str, case: Case = SHIPPED) -> str:
    """Why a lemma is not proved; empty if it is."""
    return judge(ALL[key], case).reason


def declared(**keys: Any) -> Case:
    return case_of(replace(SHIPPED.bench, shield=SHIPPED.bench.shield._replace(**keys)))


def law_with(**changed: Any) -> Case:
    return SHIPPED._replace(law=with_numbers(SHIPPED.law, **changed))


LAGGING = declared(current_lag=0.002)
COASTING = declared(envelope="coasting", angle_margin=1.2)
OBSERVED = case_of(bench_with(observer=1520.0, frame_age=(0, 1)))
EXTENSIONS = {"L10a": LAGGING, "L10b": LAGGING, "L11a": LAGGING, "L11b": LAGGING}
EXTENSIONS |= {"L12a": COASTING, "L12b": COASTING, "L12c": COASTING}
EXTENSIONS["L13"] = OBSERVED
ALL = {lemma.key: lemma for law in (LAGGING, COASTING, OBSERVED, SHIPPED) for lemma in lemmas(law)}

# --- What is proved --------------------------------------------------------------------------------------------------

PROVED: dict[str, tuple[str, Case]] = {
    **{key: (key, SHIPPED) for key in LEMMAS if key != "L4a"},
    # The whole takes 750 000 boxes; here without the last tenth of a millimetre of its slack.
    "L4a, roomy": ("L4a", law_with(spring_low=0.0)),
    **{
        f"{key}, {ranges}": (key, declared(ranges=ranges))
        for ranges in ("viscous", "viscous-stiffness", "pm50")
        for key in ("L1a", "L3a", "L5a", "L5c", "L5d", "L5f", "L5g")
    },
    **{key: (key, case) for key, case in EXTENSIONS.items()},
    "L6, observer": ("L6", OBSERVED),
}


# Half a second to four seconds of solver each: at night, and by `make proof`.
DEAR = ("L10b", "L12a", "L13", "L1c", "L1d", "L1e", "L2b", "L5b")


AT_NIGHT = pytest.mark.parametrize("dear", [False, pytest.param(True, marks=pytest.mark.slow)])


def is_dear(what: str) -> bool:
    return what.partition(",")[0] in DEAR or what.endswith(("viscous", "viscous-stiffness"))


@AT_NIGHT
def test_the_lemmas_are_proved(dear: bool) -> None:
    answers = {what: refused(*PROVED[what]) for what in PROVED if is_dear(what) == dear}
    assert len(answers) > 10
    assert answers == dict.fromkeys(answers, "")


def test_the_command_prints_every_lemma_and_says_by_its_exit_code_whether_all_are_proved(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("proof.__main__.lemmas", lambda _: (LEMMAS["L5h"], LEMMAS["L3a"]))
    assert main([]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("|")[1].strip() for line in lines[2:-2]] == ["L5h", "L3a"]
    assert all("| proved |" in line for line in lines[2:-2])
    assert lines[-2:] == ["", "2 of 2 lemmas are proved for 'drum brake, Guo 2024'"]
    monkeypatch.setattr("proof.__main__.case_of", lambda _: law_with(damping_velocity=30.0))
    assert main(["--json"]) == 1
    document = json.loads(capsys.readouterr().out)
    assert [(v["key"], v["proved"]) for v in document["lemmas"]] == [("L5h", True), ("L3a", False)]
    assert main(["--bench", "no such file"]) == 2


def test_each_law_is_judged_by_the_lemmas_of_what_it_declares() -> None:
    assert {lemma.key for lemma in lemmas(declared(break_away=1.2))} == set(LEMMAS)
    assert lemmas(SHIPPED) == BRAKING
    assert {lemma.key for lemma in lemmas(LAGGING)} == {"L1a", "L2a", "L9a", "L10a", "L10b", "L11a", "L11b"}
    assert {lemma.key for lemma in lemmas(OBSERVED)} == {*LEMMAS, "L13"}
    coasting = {"L1a", "L1b", "L1c", "L1d", "L1e", "L9a", "L12a", "L12b", "L12c"}
    assert {lemma.key for lemma in lemmas(COASTING)} == coasting


# --- What is refused -------------------------------------------------------------------------------------------------


BROKEN_LAWS: list[tuple[str, str, Case]] = [
    ("L4b", "margin too small", law_with(top=SHIPPED.law.top + 0.2, bottom=SHIPPED.law.bottom - 0.2)),
    ("L5a", "braking 1 % too strong", law_with(braking=1.01 * SHIPPED.law.box.braking)),
    ("L5d", "braking 10 % too strong", law_with(braking=1.1 * SHIPPED.law.box.braking)),
    ("L5b", "braking 10 % too strong", law_with(braking=1.1 * SHIPPED.law.box.braking)),
    ("L3a", "damping that reverses", law_with(damping_velocity=30.0)),
    ("L5c", "friction that holds the spring", law_with(friction_high=SHIPPED.law.box.spring_low * 101.0)),
    ("L5e", "damping that turns a motion around", law_with(damping_velocity=44.0)),
    ("L5f", "coming home too fast for the stroke", law_with(homeward_speed=560.0)),
    ("L5g", "spring stronger than braking", law_with(spring_high=1.2 * SHIPPED.law.box.spring_high)),
    ("L5h", "speed beyond the limit", law_with(outward_speed=500.1)),
    ("L6", "no room between the limits", law_with(top=2.0, bottom=1.9)),
    ("L1a", "law for a weaker spring", law_with(spring_high=0.99 * SHIPPED.law.box.spring_high)),
    ("L1d", "four times the viscous friction", law_with(viscous_high=4.0 * SHIPPED.law.box.viscous_high)),
    (
        "L12c",
        "apex from which no brake coasts home",
        COASTING._replace(law=with_numbers(COASTING.law, apex=COASTING.law.home.apex + 5.0)),
    ),
]


def test_a_law_with_a_wrong_number_is_refused() -> None:
    assert [row[:2] for row in BROKEN_LAWS if "broken" not in refused(row[0], row[2])] == []


def test_a_brake_outside_the_laws_set_is_refused() -> None:
    box = SHIPPED.bench.range_set("envelope")
    nominal = SHIPPED.bench.brake
    wide = Ranges(
        "wide", box.low._replace(k_m=0.4 * nominal.k_m), box.high._replace(k_m=1.6 * nominal.k_m, T_c=1.6 * nominal.T_c)
    )
    bench = replace(SHIPPED.bench, ranges={"envelope": wide})
    assert "motor low: broken" in refused("L1a", SHIPPED._replace(bench=bench))


BROKEN_FUNCTIONS = [
    ("L1b", "drives", "spring_low * (", "spring_high * ("),
    ("L1b", "drives", "(weak if weak < strong else strong)", "weak"),
    ("L1c", "fastest_next", "drive + box.friction_high -", "drive - box.friction_high -"),
    ("L1c", "fastest_next", "if vl <= 0.0:", "if vl <= -1e6:"),
    ("L1c", "_moved", "high if high > vh else vh", "high"),
    ("L1d", "fastest_next", "0.0 if fastest < 0.0 else fastest", "fastest"),
    ("L1e", "_moved", "low if low < vl else vl", "low"),
    ("L2a", "stoppable", "9.0 * half * half", "10.0 * half * half"),
    ("L2a", "stoppable", "rest = room - ts * v", "rest = room"),
    ("L2b", "_highest_current", "box.motor_high if drive > 0.0 else box.motor_low", "box.motor_low"),
    ("L2b", "_highest_current", "jumping if jumping < drive else drive", "drive"),
    ("L2b", "braking_window", "- VELOCITY_PAD\n    bottom", "\n    bottom"),
    ("L2b", "braking_window", "law.top - xh", "law.top - xl"),
    ("L3b", "damped_current", "-limit * velocity", "-0.99 * limit * velocity"),
    ("L4a", "damped_excess", "+ 0.5 * v * sample_time", "- 0.5 * v * sample_time"),
    ("L9b", "_rolled", "vh + law.change", "vh"),
    ("L9b", "damped_current", "-limit * velocity", "-0.99 * limit * velocity"),
    ("L10a", "_flowing", "max(flowing - u, 0.0)", "0.0"),
    ("L10a", "_flowing", "(i + 1) * law.change", "0.0"),
    ("L10b", "_lagging_current", "law.delay.lag * motor * (flowing + law.current)", "law.delay.lag * motor * flowing"),
    ("L10b", "_lagging_current", "vh + law.delay.lag * max(rising, 0.0)", "vh"),
    ("L12a", "_coasting_window", "- 0.5 * box.spring_high * squeezed * squeezed", ""),
    ("L12a", "_coasting_window", "max(vh + law.change, 0.0)", "max(vh, 0.0)"),
    ("L12a", "_coasting_window", "return min(bottom, 0.0)", "return max(bottom, 0.0)"),
    (
        "L13",
        "_unseen",
        "slow, fast = slow - change, fast + change",
        "slow, fast = vl - change, vh + change",
    ),
    ("L13", "_unseen", "risen += share", "risen += 0.99 * share"),
    ("L13", "_unseen", "risen = rose = blind", "risen = rose = 0.9 * blind"),
    ("L13", "_unseen", "xl - i * reach", "xl + reach"),
    ("L13", "_accelerated", "u if u < own else own", "u if u > own else own"),
    ("L13", "_accelerated", "obeyed_up = up - friction_low", "obeyed_up = up - friction_high"),
    ("L5b", "reserve", "v + limit if v >= limit else v + v", "limit if v >= limit else v"),
]


DEAR_TO_REFUTE = ("L12a", "L13", "L1e", "L2b")


@AT_NIGHT
def test_a_law_with_a_wrong_line_is_refused(dear: bool) -> None:
    rows = [row for row in BROKEN_FUNCTIONS if (row[0] in DEAR_TO_REFUTE) == dear]
    assert len(rows) > 2
    for key, name, old, new in rows:
        with pytest.MonkeyPatch.context() as patch:
            replace_in(patch, name, old, new)
            assert "broken" in refused(key, EXTENSIONS.get(key, SHIPPED)), (key, name, old)


def test_a_node_that_lets_go_where_the_law_expects_it_to_damp_is_refused() -> None:
    bench = replace(SHIPPED.bench, node=replace(SHIPPED.bench.node, stop="freewheel"))
    assert "braked" in refused("L9b", SHIPPED._replace(bench=bench))


def replace_in(monkeypatch: pytest.MonkeyPatch, name: str, old: str, new: str) -> None:
    """One of the law's functions with another text, wherever it is known."""
    function = next(getattr(m, name) for m in MODULES if hasattr(m, name))
    module: ModuleType = inspect.getmodule(function)  # type: ignore[assignment]
    source = inspect.getsource(function)
    assert source.count(old) == 1
    found: dict[str, Any] = {}
    text = "from __future__ import annotations\n" + source.replace(old, new)
    monkeypatch.setitem(linecache.cache, name, (len(text), None, text.splitlines(keepends=True), name))
    exec(compile(text, name, "exec"), vars(module), found)
    for m in MODULES:
        if hasattr(m, name):
            monkeypatch.setattr(m, name, found[name])


def test_a_law_without_its_pad_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in MODULES:
        if hasattr(module, "VELOCITY_PAD"):
            monkeypatch.setattr(module, "VELOCITY_PAD", 0.0)
    assert "growth: broken" in refused("L1d")


# --- The checker's own formulas are those of the code ----------------------------------------------------------------


def stop_distance(law: envelope_module.ShieldLaw, x: float, v: float) -> float:
    """What the damped stop of the weakest brake needs from a speed at an angle [rad], integrated by hand."""
    slope, slow = law.box.motor_low * law.current / law.damping_velocity, min(v, law.damping_velocity)
    friction = law.box.friction_low + law.box.spring_low * max(x, 0.0)
    distance = slow / slope - friction / (slope * slope) * math.log1p(slope * slow / friction) + law.sample_time * slow
    full = law.box.motor_low * law.current + friction
    return distance + 0.5 * (v * v - slow * slow) / full + 0.5 * law.sample_time * (v - slow)


def test_the_stop_that_is_counted_is_the_integral_by_hand() -> None:
    law, rng = SHIPPED.law, np.random.default_rng(1)
    for x, v in zip(rng.uniform(-10.0, 100.0, 20_000), rng.uniform(0.0, 500.0, 20_000), strict=True):
        helped = law.box.spring_low * max(x, 0.0)
        assert damped_way(law, law.box.friction_low + helped, v) == pytest.approx(stop_distance(law, x, v), rel=1e-12)


def test_the_proofs_reserve_is_never_below_the_envelopes_and_never_far_above_the_damped_stop() -> None:
    law, rng = SHIPPED.law, np.random.default_rng(2)
    most = 0.5 * 60.0**2 / law.box.braking + 0.5 * law.sample_time * 60.0 + 1e-12
    for v in rng.uniform(0.0, 500.0, 20_000):
        envelope = 0.5 * v * v / law.box.braking + 0.5 * law.sample_time * v
        assert envelope <= reserve(law, law.box.braking, v) <= envelope + most


def test_the_thrown_brake_of_the_proof_moves_like_eulers() -> None:
    law, rng = SHIPPED.law, np.random.default_rng(3)
    box = SHIPPED.bench.range_set("envelope")
    low, high = np.array(box.low), np.array(box.high)
    facts = Facts(())
    thrown = Thrown(facts, lifted_law(facts, law))
    thrown.law = law
    for _ in range(20_000):
        p = BrakeParameters(*(low + rng.random(len(low)) * (high - low)))
        thrown.motor, thrown.friction, thrown.viscous = p.k_m / p.J, p.T_c / p.J, p.f_v / p.J
        v = float(rng.uniform(0.0, 500.0))
        full = euler_step(p, -5.0, v, -law.current, law.sample_time)[1]
        assert thrown.after(v) == pytest.approx(full, abs=1e-9)
        slow = float(rng.uniform(0.0, law.damping_velocity))
        after = euler_step(p, -5.0, slow, damped(law, slow), law.sample_time)[1]
        assert thrown.damped(slow) == pytest.approx(after, abs=1e-9)


def test_full_braking_and_damped_stop_are_the_nodes() -> None:
    law = SHIPPED.law
    for v in np.linspace(-500.0, 500.0, 1001).tolist():
        own = shield_module.damped_current(v, law.current, law.damping_velocity)
        assert own == pytest.approx(damped(law, v), abs=1e-12)


def test_rounding_moves_an_end_of_the_window_by_less_than_a_billionth_of_an_ampere() -> None:
    # The law in floats and the law in real numbers both lie within the interval at a point.
    rng, n = np.random.default_rng(6), 50_000
    angle, velocity = rng.uniform(-10.0, 100.0, n), rng.uniform(-500.0, 500.0, n)
    widest = 0.0

    def statement(boxes: Boxes) -> Any:
        window = boxes.lift(shield_module.braking_window)
        law = interval_law(boxes, SHIPPED.law)

        def width(x: Any, v: Any) -> Any:
            nonlocal widest
            for end in window(
                law, x - law.angle_noise, x + law.angle_noise, v - law.velocity_noise, v + law.velocity_noise
            ):
                found = np.broadcast_to(end.high - end.low, n)[boxes.living]
            widest = max(widest, float(np.max(found, initial=0.0)))

        return width

    points = np.stack([angle, velocity], axis=1)
    slack_of(statement, ["angle", "velocity"], points, points)
    assert 0.0 < widest < 1e-9


# --- The engines -----------------------------------------------------------------------------------------------------


def test_the_solver_goes_every_way_that_is_open_and_no_other() -> None:
    ways: list[str] = []

    def statement(facts: Facts) -> None:
        x, y = facts.real("x", 0.0, 1.0), facts.real("y", 0.0, 1.0)
        way = "a" if x > 0.5 else "b"
        way += "c" if x > 0.25 else "d"  # decided where x is above a half
        way += "e" if y > x else "f"
        ways.append(way)
        facts.claim("any", 1.0, x)

    assert prove(statement).proved
    assert sorted(ways) == ["ace", "acf", "bce", "bcf", "bde", "bdf"]


SELECTIONS = {
    "b if b < a else a": "min",
    "b if b > a else a": "max",
    "a if b >= a else b": "min",
    "a.x if 0.0 <= a.x else 0.0": "max",
    "a if a < b else c": "",
    "a if a < b < c else b": "",
    "a if a == b else b": "",
    "a if a else b": "",
}


def test_a_conditional_expression_that_gives_one_of_what_it_compares_is_a_selection() -> None:
    found = {text: selection(ast.parse(text, mode="eval").body) for text in SELECTIONS}  # type: ignore[arg-type]
    assert found == SELECTIONS


SPECIAL = (0.0, -0.0, math.nan, math.inf, -math.inf, 5e-324, -5e-324, 1e-310, 1.0, -6.0, 1e300)
WITH_SELECTIONS = {
    "drives": 4,
    "fastest_next": 3,
    "successor": 5,
    "_accelerated": 5,
    "braking_window": 4,
    "_arrival": 2,
    "shield": 8,
}
"""Functions of the shield, and how many numbers each takes beside the law."""


def bits(fn: Callable[..., Any], law: Any, values: list[float]) -> object:
    """What a function gives, to the last bit, one NaN being like another; the class of what it raises."""
    numbers = values if len(values) < 8 else [*values[:3], tuple(values[3:]), 100]
    try:
        found = fn(law, *numbers)
    except (ArithmeticError, ValueError) as err:
        return type(err)
    found = found if isinstance(found, tuple) else (found,)
    return [struct.pack("<d", math.nan if math.isnan(number) else number) for number in found]


def test_a_selection_is_what_min_and_max_give_to_the_last_bit_whatever_the_numbers() -> None:
    dice = Random(11)
    for name, count in WITH_SELECTIONS.items():
        plain = getattr(shield_module, name)
        lifted = lift(plain, {})  # with min and max themselves
        for case in (SHIPPED, OBSERVED):
            for _ in range(1000):
                values = [
                    dice.choice((dice.uniform(-500.0, 500.0), *SPECIAL[: dice.randrange(12)])) for _ in range(count)
                ]
                assert bits(lifted, case.law, values) == bits(plain, case.law, values), (name, values)


def test_the_solver_finds_the_one_point_that_breaks_a_statement() -> None:
    def statement(facts: Facts) -> None:
        x = facts.real("x", 0.0, 3.0)
        facts.claim("square", (x - 2.0) * (x - 2.0), 1e-9 if x > 1.0 else 0.0)

    answer = prove(statement)
    assert not answer.proved
    assert answer.breaks.startswith("square: broken at x_1 = 2")


def test_what_states_nothing_proves_nothing() -> None:
    def impossible(facts: Facts) -> None:
        x = facts.real("x", 1.0, 0.0)
        facts.claim("never", 1.0 if x > 0.5 else 0.0, 2.0)

    assert not prove(impossible).proved


def test_a_root_or_a_quotient_that_may_not_exist_is_an_error() -> None:
    with pytest.raises(ArithmeticError):
        prove(lambda facts: facts.claim("", facts.sqrt(facts.real("x", -1.0, 1.0)), 0.0))
    with pytest.raises(ArithmeticError):
        prove(lambda facts: facts.claim("", 1.0 / facts.real("x", -1.0, 1.0), 0.0))


def test_a_law_for_which_a_formula_has_no_value_is_refused_and_not_an_error() -> None:
    assert "zero" in refused("L4b", law_with(braking=0.0))


def test_a_statement_that_takes_too_many_steps_is_undecided(monkeypatch: pytest.MonkeyPatch) -> None:
    def statement(facts: Facts) -> None:
        x = facts.real("x", 1.0, 2.0)
        facts.claim("cubes", x * x * x, x * x)

    assert prove(statement).proved
    monkeypatch.setattr("proof.terms.STEPS", (1,))
    assert prove(statement).breaks == "cubes: undecided"


def test_an_order_between_quotients_is_one_between_polynomials() -> None:
    def statement(facts: Facts) -> None:
        x, y = facts.real("x", 1.0), facts.real("y", -5.0, -1.0)
        facts.claim("over the same", (x + 1.0) / x - 1.0 / x, 1.0)
        facts.claim("and the other way", 1.0, (x + 1.0) / x - 1.0 / x)
        facts.claim("over others", 1.0 / x - 1.0 / y, 1.0 / x)
        facts.claim("of quotients", (2.0 / x) / (1.0 / x), 2.0)
        facts.claim("bounds", facts.real("z", 1.0 / x, 1.0 / x), 1.0 / x)
        assert 1.0 / y < 1.0 / x

    assert prove(statement).proved
    assert "broken" in prove(lambda facts: facts.claim("", facts.real("x", 1.0) / facts.real("y", 1.0), 1.0)).breaks


OPERATIONS: dict[str, Callable[[Any, Any], Any]] = {
    "add": lambda a, b: a + b,
    "subtract": lambda a, b: a - b,
    "multiply": lambda a, b: a * b,
    "divide": lambda a, b: a / b,
    "square": lambda a, _: a * a,
    "from a number": lambda a, b: 0.1 - a / 3.0 + 7.0 / b,
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_an_interval_contains_the_exact_result_of_every_operation_on_what_it_contains(name: str) -> None:
    rng = np.random.default_rng(4)
    n = 5000
    boxes = Boxes((), n)
    a, b = rng.normal(0.0, 10.0 ** rng.uniform(-6, 6, n)), 10.0 ** rng.uniform(-6, 6, n)
    wide = rng.uniform(0.0, 1.0, (2, n))
    x = Interval(boxes, a, a + wide[0])
    y = Interval(boxes, b, b + wide[1])
    found = OPERATIONS[name](x, y)
    tenth, third, seven = Fraction(0.1), Fraction(3), Fraction(7)
    for i in range(n):
        share = Fraction(rng.random())
        p = Fraction(x.low[i]) + share * (Fraction(x.high[i]) - Fraction(x.low[i]))
        q = Fraction(y.low[i]) + share * (Fraction(y.high[i]) - Fraction(y.low[i]))
        exact = OPERATIONS[name](p, q) if name != "from a number" else tenth - p / third + seven / q
        assert Fraction(found.low[i]) <= exact <= Fraction(found.high[i])


def test_boxes_prove_what_holds_and_find_what_does_not() -> None:
    def at_least(bound: float) -> Any:
        def statement(boxes: Boxes) -> Any:
            log1p = boxes.lift(_log_of)
            return lambda x, y: x * x - 2.0 * (x * y) + 1.5 * (y * y) + log1p(x * x) - bound

        return statement

    region = {"x": (-1.0, 2.0), "y": (-1.0, 1.0)}
    assert cover(at_least(-0.01), region, 200_000).proved
    broken = cover(at_least(0.1), region, 200_000)
    assert not broken.proved
    assert broken.breaks.startswith("broken at x = ")
    undecided = cover(at_least(0.0), region, 20_000)  # zero at the origin: no box there is ever decided
    assert not undecided.proved
    assert undecided.breaks.startswith("undecided")


def _log_of(value: Any) -> Any:
    return math.log1p(value)


def test_a_branch_that_only_some_boxes_take_counts_for_them_alone() -> None:
    def statement(boxes: Boxes) -> Any:
        return lambda x: (x + 1.0) if x < 0.0 else (2.0 - x)

    assert cover(statement, {"x": (-0.9, 1.9)}, 10_000).proved
    assert "broken" in cover(statement, {"x": (-0.9, 2.1)}, 10_000).breaks
    assert "broken" in cover(statement, {"x": (-1.1, 1.9)}, 10_000).breaks
