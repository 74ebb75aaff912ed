"""The parts that a report is made of: markup, numbers, figures."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from emb_bench.figures import svg
from emb_bench.numbers import around, between, chance, percent, plain, seconds
from emb_bench.report.certainty import ellipse
from emb_bench.report.figures import autocorrelation, crosscorrelation
from emb_bench.report.markup import Section, join, listed, page, table, tag

from tests.bench.report_pages import Reader, read  # isort: skip

WORDS = st.text(st.characters(exclude_categories=("Cs", "Cc")), max_size=60)


@given(text=WORDS, attribute=WORDS)
def test_any_text_is_read_back_as_that_text_and_nothing_else(text: str, attribute: str) -> None:
    reader = Reader()
    reader.feed(tag("html", tag("body", tag("p", text, title=attribute))))
    reader.close()
    assert reader.tags == ["html", "body", "p"]
    assert reader.values("title") == [attribute]
    assert "".join(reader.texts) == (text if text.strip() else "")


def test_control_characters_do_not_reach_the_page() -> None:
    assert join("a\x00b\x1b[31mc\x9fd\ud800e\n\tf") == "a\ufffdb\ufffd[31mc\ufffdd\ufffde\n\tf"


def test_markup_is_left_alone_and_nothing_makes_nothing() -> None:
    assert tag("p", tag("b", "<"), None, ["&", [tag("br")]]) == "<p><b>&lt;</b>&amp;<br></p>"
    assert tag("i", cls="x", data_y=None) == '<i class="x"></i>'
    assert listed([]) is None


def test_a_table_names_its_rows_and_columns_for_who_cannot_see_it() -> None:
    reader = Reader()
    reader.feed(table(["name", "n"], [["a", "1"], ["b", "2"]], "two rows"))
    assert reader.values("scope") == ["col", "col", "row", "row"]
    assert set(reader.values("aria-label")) == {"two rows"}


def test_the_contents_are_one_line_of_links_to_the_main_sections() -> None:
    inner = Section("Inner", "x", name="other")
    reader = read(page("t", None, [Section("First: of all", "y"), Section("Second", within=[inner])], "end"))
    assert reader.values("href") == ["#first-of-all", "#second"]
    assert reader.values("id") == ["first-of-all", "second", "other"]
    assert reader.headings == ["First: of all", "Second", "Inner"]


def test_the_page_forbids_scripts_and_the_network() -> None:
    reader = read(page("t", None, [Section("a")], "end"))
    policy = dict(part.strip().split(" ", 1) for part in reader.values("content")[0].split(";"))
    assert policy["default-src"] == "'none'"
    assert set(policy) == {"default-src", "style-src", "img-src", "base-uri", "form-action"}
    assert policy["img-src"] == "data:"
    assert "@import" not in page("t", None, [Section("a")], "end")


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


def test_what_is_no_number_is_said() -> None:
    assert (plain(np.nan), plain(np.inf), plain(-np.inf)) == ("–", "∞", "−∞")
    assert around(2.5e-5, np.inf) == "2.5 × 10⁻⁵"
    assert between(-np.inf, 2.0) == "−∞ to 2"
    assert between(2.1586e-5, 2.1598e-5) == "(2.1586 to 2.1598) × 10⁻⁵"
    assert [percent(x) for x in (0.0, 1e-5, 0.034, 0.51, 0.996, 1.0)] == [
        "0 %",
        "< 0.1 %",
        "3.4 %",
        "51 %",
        "99.6 %",
        "100 %",
    ]
    assert (chance(1e-58), chance(0.056)) == ("< 10⁻⁶", "0.056")
    assert [seconds(x) for x in (2.0, 3.4e-3, 5.6e-5, 0.0)] == ["2 s", "3.4 ms", "56 µs", "0 µs"]


def test_an_ellipse_holds_95_percent_of_a_gaussian() -> None:
    covariance = np.array([[4.0, -1.9], [-1.9, 1.0]])
    border = ellipse(covariance)
    squares = np.einsum("ni,ij,nj->n", border, np.linalg.inv(covariance), border)
    assert squares == pytest.approx(stats.chi2.ppf(0.95, 2))


def test_correlations_leave_lost_samples_out() -> None:
    rng = np.random.default_rng(1)
    errors, currents = rng.normal(size=300), rng.normal(size=300)
    errors[[5, 6, 100]] = np.nan
    own, bound = autocorrelation(errors, 4)
    filled = np.where(np.isnan(errors), 0.0, errors)
    assert own == pytest.approx([np.correlate(filled[k:], filled[:-k])[0] / (filled @ filled) for k in (1, 2, 3, 4)])
    assert bound == pytest.approx(1.96 / 297**0.5)
    cross, _ = crosscorrelation(errors, currents, 3)
    for lag, value in enumerate(cross):
        a, b = errors[lag:], currents[: 300 - lag]
        assert value == pytest.approx(np.corrcoef(a[np.isfinite(a)], b[np.isfinite(a)])[0, 1])
    assert autocorrelation(np.full(4, np.nan), 20)[0].tolist() == [0.0] * 3


def test_a_figure_is_the_same_bytes_each_time_and_its_text_is_text() -> None:
    def draw(axes: object) -> None:
        axes[0, 0].plot([1, 2], [3, 4])  # type: ignore[index]
        axes[0, 0].set_xlabel("time [ms]")  # type: ignore[index]

    first, second = (svg(draw, 1, 1, (3.0, 2.0)) for _ in range(2))
    assert first == second
    assert b">time [ms]</text>" in first
    assert not re.search(rb"<script|href=\"(?!#)", first)
