"""The parts that a report is made of: markup, numbers, figures, and sentences on a model that does not fit."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_bench.config.bench import Bench
from emb_bench.figures import svg
from emb_bench.numbers import chance, percent, seconds, share, share_between, signed
from emb_bench.report.page import environment
from emb_bench.report.sentences import alarms
from emb_bench.report.text import Cell, Table, show
from emb_runtime.numbers import around, between, in_percent, plain
from tests.bench.measurements import currents_of, fit, record
from tests.bench.report_pages import Reader, read

WORDS = st.text(st.characters(exclude_categories=("C", "Z"), include_characters=" "), max_size=60)


def html_of(table: Table) -> str:
    """A table as HTML, in a page."""
    return f"<html><body>{environment().get_template('macros.html.j2').module.table(table)}</body></html>"  # type: ignore[attr-defined]


@given(text=WORDS)
def test_any_text_is_read_back_as_that_text_and_nothing_else(text: str) -> None:
    table = Table(text, [text, "n"], [[text, Cell(text, "bad")]])
    reader = Reader()
    reader.feed(html_of(table))
    reader.close()
    assert set(reader.tags) <= {"html", "body", "div", "p", "table", "thead", "tbody", "tr", "th", "td", "strong"}
    assert reader.values("aria-label") == ([text, text] if text else [])
    assert [t for t in reader.texts if t.strip() and t != "n"] == [text] * 4 * bool(text.strip())


def test_control_characters_do_not_reach_the_page() -> None:
    assert "a\\x00b\\x1b[31mc\\x9fd\\ud800e\n\tf\\u202eg\\u200bh" in html_of(
        Table("", ["", ""], [["a\x00b\x1b[31mc\x9fd\ud800e\n\tf\u202eg\u200bh", "1"]])
    )


def test_a_table_names_its_rows_and_columns_for_who_cannot_see_it() -> None:
    table = Table("two rows", ["name", "n"], [["a", "1"], ["b", "2"]])
    reader = read(html_of(table))
    assert reader.values("scope") == ["col", "col", "row", "row"]
    assert set(reader.values("aria-label")) == {"two rows"}


def _number(text: str) -> float:
    mantissa, _, power = text.replace("−", "-").partition(" × 10")
    return float(mantissa.strip("()")) * 10.0 ** int(power.translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")) or 0)


@given(st.floats(1e-9, 1e9), st.floats(1e-7, 0.5))
def test_a_value_is_written_to_a_twentieth_of_its_interval_and_can_be_read_back(value: float, share: float) -> None:
    text, _, power = around(value, share * value).partition(") × ")
    middle, half = text.strip("(").split(" ± ")
    power = f" × {power}" if power else ""
    assert abs(_number(middle + power) - value) <= 0.051 * share * value
    assert _number(half + power) == pytest.approx(share * value, rel=0.051)


@given(st.floats(-1e9, 1e9).filter(lambda x: abs(x) > 1e-9))
def test_a_plain_number_keeps_three_digits(value: float) -> None:
    assert _number(plain(value)) == pytest.approx(value, rel=0.0051)


def test_numbers_are_written_for_people() -> None:
    table: dict[Callable[[float], str], list[tuple[float, str]]] = {
        plain: [(np.nan, "–"), (np.inf, "∞"), (-np.inf, "−∞"), (-2.16e-5, "−2.16 × 10⁻⁵"), (1.41e5, "1.41 × 10⁵")],
        in_percent: [(1.4, "140 %"), (0.9996, "100 %"), (-3.06, "−306 %"), (1.4e-5, "0.0014 %"), (4e-9, "4 × 10⁻⁷ %")],
        signed: [(140.0, "+140"), (-306.0, "−306"), (1.4e5, "+1.4 × 10⁵"), (-1e-9, "−1 × 10⁻⁹"), (-0.0, "0")],
        percent: [(0.0, "0 %"), (1e-5, "< 0.1 %"), (0.034, "3.4 %"), (0.51, "51 %"), (0.996, "99.6 %"), (1.0, "100 %")],
        chance: [(1e-58, "< 10⁻⁶"), (0.056, "0.056")],
        seconds: [(2.0, "2 s"), (3.4e-3, "3.4 ms"), (5.6e-5, "56 µs"), (0.0, "0 µs")],
        share: [(5.4e-6, "5.4 ppm"), (5.13e-4, "513 ppm"), (-2.5e-6, "−2.5 ppm"), (0.0139, "1.4 %"), (2.5, "250 %")],
    }
    for form, cases in table.items():
        for value, text in cases:
            assert form(value) == text
    of_two: dict[Callable[[float, float], str], list[tuple[float, float, str]]] = {
        around: [
            (0.0216999, 2.9e-7, "(2.169990 ± 0.000029) × 10⁻²"),
            (0.0217, 4.4e-4, "0.02170 ± 0.00044"),
            (23.04007, 9.96e-5, "23.04007 ± 0.00010"),
            (1.0, 5e-324, "1"),
            (2.5e-5, np.inf, "2.5 × 10⁻⁵"),
            (-6e-7, 0.48, "0.00 ± 0.48"),
            (2e-9, 4e-7, "(0.0 ± 4.0) × 10⁻⁷"),
        ],
        between: [(-np.inf, 2.0, "−∞ to 2"), (2.1586e-5, 2.1598e-5, "(2.1586 to 2.1598) × 10⁻⁵")],
        share_between: [(-8e-6, 7.9e-6, "−8 to +8 ppm"), (-8e-6, 0.02, "0.0 to +2.0 %"), (-np.inf, 0.02, "−∞ to 2 %")],
    }
    for both, pairs in of_two.items():
        for first, second, text in pairs:
            assert both(first, second) == text


def test_a_figure_is_the_same_bytes_each_time_and_its_text_is_text() -> None:
    def draw(axes: object) -> None:
        axes[0, 0].plot([1, 2], [3, 4])  # type: ignore[index]
        axes[0, 0].set_xlabel("time [ms]")  # type: ignore[index]

    first, second = (svg(draw, 1, 1, (3.0, 2.0)) for _ in range(2))
    assert first == second
    assert b">time [ms]</text>" in first
    assert not re.search(rb"<script|href=\"(?!#)", first)


TEXT = "WARNING: THE MODEL 'x' DOES NOT FIT.\n  k_m  1 ± 2 N·m/A  yes\n  f_v  3; NOT identified: [b]flat[/b]"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_shows_verdicts_in_colour_unless_it_is_asked_not_to(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    show(TEXT)
    assert capsys.readouterr().out == f"{TEXT}\n"
    monkeypatch.setenv("TERM", "xterm-256color")
    for no_color in ("", "1"):
        out = Terminal()
        monkeypatch.setattr("sys.stdout", out)
        monkeypatch.setenv("NO_COLOR", no_color)
        show(TEXT)
        shown = out.getvalue()
        assert ("\x1b[1;31mWARNING: THE MODEL" in shown, "\x1b[32myes" in shown) == (not no_color, not no_color)
        assert "[b]flat[/b]" in shown


@pytest.mark.parametrize(
    ("plant", "text", "said"),
    [
        ("stribeck", "square:period=0.2", "a static friction beyond T_c of about 20 % explains the misfit (24 sigma)"),
        ("late", "chirp", "a delay of the commands explains 99 % of the misfit (31 sigma)"),
    ],
)
def test_an_effect_explains_a_misfit_only_where_none_is_left(bench: Bench, plant: str, text: str, said: str) -> None:
    e = fit(bench, "exact", [record(bench, bench.plant(plant), currents_of(bench, text))])
    assert alarms(e)[0].startswith(said)
    m = e.validation
    assert m.cause is not None
    left = (m.chi2 - m.cause.suspect.fall) / (m.freedom - 1)
    assert (m.cause.share == 1.0) is (left <= m.expected[1]) is ("% of the misfit" not in said)


@pytest.mark.parametrize("text", ["chirp", "square:period=0.2"])
@pytest.mark.parametrize(("quadratic", "cubic"), [(0.02, -0.0007), (0.01, -0.0004), (-0.02, 0.0007), (-0.012, 0.0003)])
def test_two_terms_of_a_curve_that_nearly_cancel_are_named_together(
    bench: Bench, quadratic: float, cubic: float, text: str
) -> None:
    """Alone each leaves a misfit, and another effect seems to explain more."""
    exact = bench.plant("exact")
    curved = replace(exact, mechanics=exact.mechanics._replace(quadratic=quadratic, cubic=cubic))
    said = alarms(fit(bench, exact, [record(bench, curved, currents_of(bench, text))]))[0]
    assert said.startswith("a stiffness with a quadratic and a cubic term explains ")
    assert "remedy: estimate it as well: --nuisance quadratic,cubic" in said


@pytest.mark.parametrize(
    ("quadratic", "said"),
    [
        (0.0005, "a quadratic stiffness of about 0.00048 1/rad explains the misfit (28 sigma)"),
        (0.0001, "a quadratic stiffness is the most significant (10 sigma)"),
    ],
)
def test_one_term_of_a_curve_is_named_with_its_amount_if_it_explains_residuals_that_are_too_large(
    bench: Bench, quadratic: float, said: str
) -> None:
    """Residuals that are not too large leave no misfit to explain."""
    exact = bench.plant("exact")
    curved = replace(exact, mechanics=exact.mechanics._replace(quadratic=quadratic))
    e = fit(bench, exact, [record(bench, curved, currents_of(bench, "chirp"))])
    assert alarms(e)[0].startswith(said)
    assert ("size" in e.validation.alarming) is ("explains" in said)
