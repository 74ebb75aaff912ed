"""[plants.*] and [budgets] of a bench file: what is read, and what is refused with file, key and reason."""

from __future__ import annotations

import pytest

from emb_bench.config.bench import Bench, parse_bench
from emb_bench.config.plants import DIRECTED, EXACT, Instruments, Mechanics, Plant
from emb_runtime.config.bench import shipped_bench_text
from emb_runtime.errors import BenchFileError
from tests.benches import SENSOR_TEXT

TEXT, _, _ = SENSOR_TEXT.partition("# Brakes to simulate")


def read(*lines: str, name: str = "mine") -> Plant:
    return parse_bench("\n".join([TEXT, f"[plants.{name}]", *lines]), "my.toml").plant(name)


def test_a_bench_without_plants_has_the_thesis_s_two() -> None:
    plain = parse_bench(TEXT, "my.toml")
    assert list(plain.plants) == ["euler", "exact"]
    assert plain.plant("euler") == Plant("euler", Mechanics(solver=0), Instruments())
    assert plain.plant("exact") == Plant("exact", Mechanics(), Instruments())


def test_the_shipped_bench_has_a_plant_for_every_feature(bench: Bench) -> None:
    ideal: dict[str, object] = {**Mechanics()._asdict(), **Instruments()._asdict()}
    changed = {
        key
        for plant in bench.plants.values()
        for key, value in {**plant.mechanics._asdict(), **plant.instruments._asdict()}.items()
        if value != ideal[key]
    }
    # 2 and 1 rad are both the default and the sources' values.
    assert changed == set(ideal) - {"stribeck_exponent", "hysteresis_travel", "tolerance", DIRECTED}
    assert all(name == plant.name for name, plant in bench.plants.items())


def test_a_plant_that_says_nothing_is_the_exact_brake_with_ideal_instruments() -> None:
    assert read() == Plant("mine", Mechanics(solver=EXACT), Instruments())


def test_what_is_said_is_read_and_the_rest_has_its_default() -> None:
    plant = read("break_away = 1.5", "current_lag = 0.001", "command_delay = 3", "encoder_offset = -0.1")
    assert plant.mechanics == Mechanics(break_away=1.5, current_lag=0.001)
    assert plant.instruments == Instruments(command_delay=3, encoder_offset=-0.1)
    euler = read('solver = "euler"', "clock_jitter = 1e-5")
    assert (euler.mechanics.solver, euler.instruments.clock_jitter) == (0, 1e-5)


def test_what_makes_no_plant_is_refused_with_file_key_and_reason() -> None:
    for lines, key, reason in [
        (['solver = "rk4"'], "solver", "one of euler, exact"),
        (["solver = 2"], "solver", "got 2"),
        (["mass = 1"], "mass", "unknown key"),
        (["break_away = 0.9"], "break_away", "from 1 to 5"),
        (["break_away = nan"], "break_away", "finite"),
        (['break_away = "1"'], "break_away", "got a text in quotes, '1'"),
        (["stribeck_velocity = 0.5"], "stribeck_velocity", "from 1 to 500"),
        (["stribeck_velocity = 10.0", "stribeck_exponent = 5"], "stribeck_exponent", "from 1 to 4"),
        (["stribeck_exponent = 2.0"], "stribeck_exponent", "no effect without stribeck_velocity"),
        (["f_l = -1e-6"], "f_l", "from 0 to 0.0001"),
        (["quadratic = 2"], "quadratic", "from -1 to 1"),
        (["cubic = -2"], "cubic", "from -1 to 1"),
        (["hysteresis = 0.6"], "hysteresis", "from 0 to 0.5"),
        (["hysteresis_travel = 1.0"], "hysteresis_travel", "no effect without hysteresis"),
        (["hysteresis = 0.1", "hysteresis_travel = 0"], "hysteresis_travel", "from 0.01 to 100"),
        (["play = 11"], "play", "0 to 10"),
        (["play = 0.1", "hysteresis = 0.1"], "play", "does not go with hysteresis"),
        (["viscous_asymmetry = 0.1", "play = 0.1"], "play", "does not go with viscous_asymmetry"),
        (["current_lag = 0"], "current_lag", "1e-05 to 0.1"),
        (["current_lag = true"], "current_lag", "got true"),
        (["command_delay = 11"], "command_delay", "from 0 to 10"),
        (["command_delay = 1.0"], "command_delay", "whole number"),
        (["measurement_delay = -1"], "measurement_delay", "from 0 to 10"),
        (["encoder_offset = 11"], "encoder_offset", "-10 to 10"),
        (["clock_jitter = 0.1"], "clock_jitter", "0 to 0.001"),
        (["observer_bandwidth = 5"], "observer_bandwidth", "300 to 6000"),
        (["observer_bandwidth = 6001"], "observer_bandwidth", "300 to 6000"),
        (['solver = "euler"', "current_lag = 0.002"], "current_lag", 'goes with solver = "exact", not with "euler"'),
        (['solver = "euler"', "break_away = 1.2"], "break_away", 'goes with solver = "exact"'),
    ]:
        with pytest.raises(BenchFileError) as caught:
            read(*lines)
        message = str(caught.value)
        assert message.startswith(f"my.toml: plants.mine.{key}: "), message
        assert reason in message
        assert "\n" not in message


def test_the_built_in_plants_cannot_be_redefined() -> None:
    for name in ("euler", "exact"):
        with pytest.raises(BenchFileError, match=f"plants.{name}: this name is taken"):
            read(name=name)


def test_a_name_that_a_command_could_not_take_is_refused() -> None:
    for name in ["all", '""', '"a b"', '"a,f_v=1"', '"a\\nb"', '"\\u001b[31m"', "a" * 41]:
        with pytest.raises(BenchFileError, match="expected a name of 1 to 40 letters") as caught:
            read(name=name)
        assert str(caught.value).isprintable()


def test_plants_that_are_no_tables_are_refused() -> None:
    with pytest.raises(BenchFileError, match=r"plants\.mine: expected a table"):
        parse_bench(f"{TEXT}\n[plants]\nmine = 3\n", "my.toml")
    with pytest.raises(BenchFileError, match="plants: expected a table"):
        parse_bench(f"plants = 3\n{TEXT}", "my.toml")


def with_budgets(budgets: str) -> Bench:
    text = shipped_bench_text()
    begin, end = text.index("[budgets]"), text.index("# Brakes to simulate")
    return parse_bench(text[:begin] + budgets + "\n" + text[end:], "b.toml")


def test_budgets_are_read_as_they_stand() -> None:
    budgets = with_budgets('[budgets]\nmissed = 0\nnot_obeyed = 1\n[budgets.age]\n"p99.9" = 2e-4\np100 = 1').budgets
    assert budgets is not None
    assert budgets.shares == {"missed": 0.0, "not_obeyed": 1.0}
    assert budgets.intervals == {"age": {"p99.9": 2e-4, "p100": 1.0}}


def test_neither_plants_nor_budgets_are_part_of_what_a_policy_depends_on(bench: Bench) -> None:
    assert parse_bench(TEXT, "my.toml").identity_hash == bench.identity_hash
    assert with_budgets("").identity_hash == parse_bench(shipped_bench_text(), "t").identity_hash


def test_the_shipped_response_is_well_within_the_period() -> None:
    bench = parse_bench(shipped_bench_text(), "t")
    assert bench.budgets is not None
    assert max(bench.budgets.intervals["response"].values()) < 0.75 * bench.timing.sample_time


def test_a_budget_that_makes_no_sense_is_refused_with_its_name() -> None:
    for budgets, reason in [
        ("[budgets]\nmissing = 0.1", "budgets.missing: unknown key; expected some of .*missed"),
        ("[budgets]\nmissed = 1.5", "budgets.missed: expected a number from 0 to 1, got 1.5"),
        ("[budgets]\nresponse = 1", "budgets.response: expected a table, got a number, 1"),
        ("[budgets.slack]\np50 = 1e-3", "budgets.slack: unknown key"),
        ("[budgets.age]\np42 = 1e-3", "budgets.age.p42: unknown key; expected one of p100, p50, p90, p99, p99.9"),
        ("[budgets.age]\np99 = 0", "budgets.age.p99: expected a number above 0, at most 1, got 0"),
        ("[budgets.age]\np99 = 300", "budgets.age.p99: expected a number above 0, at most 1, got 300"),
        ('[budgets.age]\np99 = "fast"', "budgets.age.p99: expected a number"),
    ]:
        with pytest.raises(BenchFileError, match=f"^b.toml: {reason}"):
            with_budgets(budgets)
