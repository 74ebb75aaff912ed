"""bench.toml: what is read, and what is refused with file, key and reason."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_bench.config.bench import Bench, parse_bench
from emb_runtime.config.bench import PARAMETER_NAMES, Sensors, shipped_bench_text
from emb_runtime.errors import EXIT_USAGE, BenchFileError
from emb_runtime.safety.shield_design import make_law
from tests.benches import SENSOR_BENCH, SENSOR_TEXT

TEXT = shipped_bench_text()


def test_the_shipped_bench_is_table_4_1(bench: Bench) -> None:
    assert bench.brake == (4.624e-6, 1.889e-5, 2.170e-2, 2.304e1, 1.037e-2, 2.160e-5)
    assert (bench.limits.current, bench.limits.angle, bench.limits.velocity) == (6.0, (-10.0, 100.0), 500.0)
    assert bench.noise.angle**2 == pytest.approx(1e-6)
    assert bench.noise.velocity**2 == 1.0
    assert (bench.timing.sample_time, bench.timing.sample_time_ns, bench.timing.horizon) == (1e-3, 1_000_000, 500)


def test_the_shipped_ranges_are_those_of_the_thesis_and_plus_minus_50_percent(bench: Bench) -> None:
    viscous = bench.range_set("viscous")
    assert viscous.low._replace(f_v=bench.brake.f_v) == bench.brake == viscous.high._replace(f_v=bench.brake.f_v)
    assert (viscous.low.f_v, viscous.high.f_v) == (1e-5, 5e-5)
    two = bench.range_set("viscous-stiffness")
    assert (two.low.k_1, two.high.k_1) == (25.0, 50.0)
    assert two.uncovered(bench.brake, bench.brake) == ("k_1",)  # as the thesis prints it: the nominal k_1 lies outside
    half = bench.range_set("pm50")
    for name in PARAMETER_NAMES:
        assert getattr(half.low, name) == pytest.approx(0.5 * getattr(bench.brake, name))
        assert getattr(half.high, name) == pytest.approx(1.5 * getattr(bench.brake, name))


def test_the_shield_covers_every_brake_that_the_shipped_actor_meets(bench: Bench) -> None:
    envelope = bench.range_set(bench.shield.ranges)
    for name in ("viscous", "pm50"):
        inner = bench.range_set(name)
        assert envelope.uncovered(inner.low, inner.high) == ()


def test_what_is_wrong_is_refused_with_file_key_and_reason() -> None:
    for old, new, key, reason in [
        ("schema = 1", "schema = 2", "schema", "expected 1, got 2"),
        ("schema = 1", "schema = 1\nspeed = 3", "speed", "unknown key"),
        ("J     = 4.624e-6", "J     = -4.624e-6", "brake.J", "above 0"),
        ("J     = 4.624e-6", 'J     = "big"', "brake.J", "got a text in quotes, 'big'"),
        ("J     = 4.624e-6", "J     = true", "brake.J", "got true"),
        ("J     = 4.624e-6", "J     = nan", "brake.J", "finite"),
        ("J     = 4.624e-6", "", "brake.J", "missing"),
        ("k_m   = 2.170e-2", "k_m   = inf", "brake.k_m", "finite"),
        ("current  = 6.0", "current  = 6.5", "limits.current", "(0, 6] A"),
        ("angle    = [-10.0, 100.0]", "angle    = [-10.0, 101.0]", "limits.angle", "beyond the ceiling"),
        ("angle    = [-10.0, 100.0]", "angle    = [50.0, 20.0]", "limits.angle", "is above the upper"),
        ("angle    = [-10.0, 100.0]", "angle    = [1.0, 100.0]", "limits.angle", "origin"),
        ("angle    = [-10.0, 100.0]", "angle    = 100.0", "limits.angle", "expected [a number, a number]"),
        ("velocity = 500.0", "velocity = 501.0", "limits.velocity", "(0, 500]"),
        ("horizon     = 500", "horizon     = 500.5", "timing.horizon", "whole number"),
        ("horizon     = 500", "horizon     = 0", "timing.horizon", "from 1"),
        ("sample_time = 1.0e-3", "sample_time = 1.0", "timing.sample_time", "0.0001 to 0.1"),
        ('ranges        = "envelope"', 'ranges        = "wide"', "shield.ranges", "no set [ranges.wide]"),
        ("frame_age     = [0, 0]", "frame_age     = [1, 0]", "shield.frame_age", "is above the upper"),
        ("frame_age     = [0, 0]", "frame_age     = [0, 6]", "shield.frame_age", "from 0 to 5"),
        ("f_v = [1.0e-5, 5.0e-5]", "f_v = [0.0, 5.0e-5]", "ranges.viscous.f_v[0]", "above 0"),
        ("f_v = [1.0e-5, 5.0e-5]", "mass = [1.0, 2.0]", "ranges.viscous.mass", "unknown key"),
        ("soft_missed  = 5", "soft_missed  = 50", "watch.soft_missed", "above stop_missed"),
        ("stop_missed  = 20", "stop_missed  = 4000", "watch.stop_missed", "from 1 to 400"),
        ("heartbeat    = 0.005", "heartbeat    = 0.001", "watch.heartbeat", "from 0.002 to 0.5 s"),
        ("sample_time = 1.0e-3", "sample_time = 4.0e-3", "watch.heartbeat", "from 0.008 to 0.5 s"),
        ('stop             = "damped"', 'stop             = "hold"', "node.stop", "one of damped, freewheel"),
        ("watchdog         = 0.010", "watchdog         = 5.0", "node.watchdog", "from 0.002 to 0.5 s"),
        ("watchdog         = 0.010", "watchdog         = 0.001", "node.watchdog", "from 0.002 to 0.5 s"),
        ("current_lag   = 0.0", "current_lag   = -1e-3", "shield.current_lag", "a number from 0 to 0.1"),
        ("break_away    = 1.0", "break_away    = 0.9", "shield.break_away", "a number from 1 to 5"),
        ("f_l           = 0.0", "f_l           = 2.0e-4", "shield.f_l", "a number from 0 to 0.0001"),
        ('envelope      = "braking"', 'envelope      = "gliding"', "shield.envelope", "one of braking, coasting"),
        ("f_l           = 0.0", "f_k           = 0.0", "shield.f_k", "unknown key; expected some of"),
        ("home_angle    = 0.5", "home_angle    = 1e20", "shield.home_angle", "above 0, at most 10"),
        ("home_velocity = 5.0", "home_velocity = 1e9", "shield.home_velocity", "above 0, at most 50"),
        ('name = "drum brake, Guo 2024"', 'name = "drum\\nbrake"', "name", "printable"),
        ("schema = 1", 'schema = 1\n"a\\nb" = 3', r"'a\nb'", "unknown key"),
        ("bitrate = 1000000", "bitrate = 10", "can.bitrate", "from 125000"),
        ("bitrate = 1000000", 'bitrate = 1000000\nmapping = "AB"', "can.mapping", "expected a SHA-256, 64 digits"),
        ("[can]", "[can", "", "not valid TOML"),
        ("J     = 4.624e-6", "J     = 1e-320", "brake.J", "size from"),
        ("J     = 4.624e-6", "J     = 4.624e-12", "brake", "of at least 0.0001 s in all ranges"),
        ("f_v = [1.0e-5, 5.0e-5]", "f_v = [1.0e-5, 5.0]", "brake", "of at least 0.0001 s in all ranges"),
        ("J     = 4.624e-6", "J     = 1" + "0" * 400, "brake.J", "finite"),
        ("J     = 4.624e-6", "J     = 1" + "0" * 5000, "", "not valid TOML"),
        ("k_m   = 2.170e-2", "k_m   = 9.0e-2", "shield.ranges", "leaves out the nominal k_m = 0.09"),
        ("inertia        = 0.01 ", "k_m = 0.0\ninertia = 0.01 ", "systematic.k_m", "above 0"),
        ("[can]\nbitrate = 1000000", "can = 3", "can", "expected a table"),
        *(
            ("[timing]", f"[sensors]\n{wrong}\n[timing]", f"sensors.{key}".rstrip("."), reason)
            for wrong, key, reason in (
                ('velocity = "derived"', "velocity", "one of observer, sensor"),
                ('velocity = "observer"', "", "needs observer_bandwidth in rad/s, its least, or velocity_lag in s"),
                ("observer_bandwidth = 1520.0", "observer_bandwidth", 'goes with velocity = "observer"'),
                ('velocity = "sensor"\nvelocity_lag = 0.001', "velocity_lag", 'goes with velocity = "observer"'),
                (
                    'velocity = "observer"\nobserver_bandwidth = 1520.0\nvelocity_lag = 0.001',
                    "velocity_lag",
                    "expected one of the two",
                ),
                ('velocity = "observer"\nobserver_bandwidth = 0.0', "observer_bandwidth", "above 0"),
                ('velocity = "observer"\nvelocity_lag = 0.0', "velocity_lag", "above 0"),
                ('velocity = "observer"\nvelocity_lag = 1.0', "velocity_lag", "0.1"),
                ('velocity = "observer"\nobserver_damping = 0.7', "observer_damping", "unknown key"),
            )
        ),
    ]:
        text = SENSOR_TEXT if "[sensors]" in new else TEXT
        assert old in text
        broken = text.replace(old, new, 1)
        if new == "can = 3":  # a bare key has to stand before the first table
            broken = "can = 3\n" + TEXT.replace(old, "", 1)
        with pytest.raises(BenchFileError) as caught:
            parse_bench(broken, "my.toml")
        message = str(caught.value)
        assert message.startswith(f"my.toml: {key}"), (new, message)
        assert reason in message, new
        assert "\n" not in message
        assert caught.value.exit_code == EXIT_USAGE


def test_a_declared_observer_belongs_to_the_identity_and_a_declared_sensor_is_what_is_assumed() -> None:
    def declaring(text: str) -> Bench:
        return parse_bench(SENSOR_TEXT.replace("[timing]", f"[sensors]\n{text}\n[timing]"), "t")

    sensor = declaring('velocity = "sensor"')
    observers = [declaring(f'velocity = "observer"\nobserver_bandwidth = {w}') for w in (800.0, 1520.0)]
    assert (sensor.sensors, sensor.identity_hash) == (SENSOR_BENCH.sensors, SENSOR_BENCH.identity_hash)
    lagging = declaring('velocity = "observer"\nvelocity_lag = 0.0008')
    assert observers[1].sensors == Sensors("observer", 1520.0)
    assert lagging.sensors == Sensors("observer", velocity_lag=8e-4)
    assert len({b.identity_hash for b in (sensor, *observers, lagging)}) == 4


def test_an_observer_that_is_known_by_its_lag_alone_counts_as_one_of_second_order(bench: Bench) -> None:
    assert [Sensors("observer", velocity_lag=1e-3).bandwidth, Sensors("observer", 800.0).bandwidth] == [900.0, 800.0]
    assert (Sensors().bandwidth, bench.sensors.bandwidth) == (None, 1520.0)
    lagging, known = (replace(bench, sensors=s) for s in (Sensors("observer", None, 1e-3), Sensors("observer", 900.0)))
    assert make_law(lagging) == make_law(known)
    with pytest.raises(
        BenchFileError, match=r"a sensors\.velocity_lag of 0\.0012 s at most, got 450 rad/s, or 0\.002 s"
    ):
        make_law(replace(bench, sensors=Sensors("observer", None, 2e-3)))


def test_all_that_an_old_file_lacks_is_named_at_once_with_where_to_find_it() -> None:
    old = TEXT.replace("heartbeat    = 0.005", "").replace("damping_velocity = 60.0", "")
    old = old[: old.index("[guard]")] + old[old.index("[node]") :]
    with pytest.raises(BenchFileError) as caught:
        parse_bench(old, "old.toml")
    assert str(caught.value).startswith("old.toml: guard, watch.heartbeat, node.damping_velocity: missing; ")
    assert "emb-run --write-bench" in str(caught.value)


def test_what_a_file_may_leave_out_is_not_missed() -> None:
    lines = [
        line for line in TEXT.splitlines() if not line.startswith(("envelope", "current_lag", "break_away", "f_l"))
    ]
    short = "\n".join(lines).partition("[budgets]")[0]
    assert (parse_bench(short, "t").budgets, parse_bench(short, "t").shield.break_away) == (None, 1.0)


def test_the_shipped_time_outs_are_the_longest_with_which_a_brake_is_driven(bench: Bench) -> None:
    bench.refuse_long_timeouts()
    for old, tight in [("stop_missed  = 20", "= 6"), ("rejected     = 5", "= 1"), ("heartbeat    = 0.005", "= 0.002")]:
        parse_bench(TEXT.replace(old, f"{old.split(' ')[0]} {tight}"), "t").refuse_long_timeouts()


def test_a_longer_time_out_is_read_and_not_armed() -> None:
    for old, long, message in [
        ("stop_missed  = 20", "stop_missed = 21", "watch.stop_missed: expected at most 20, got 21"),
        ("rejected     = 5", "rejected = 6", "watch.rejected: expected at most 5, got 6"),
        ("rejected     = 5", "rejected = 16", "watch.rejected: expected at most 5, got 16"),
        ("heartbeat    = 0.005", "heartbeat = 0.0051", "watch.heartbeat: expected at most 0.005, got 0.0051"),
        ("heartbeat    = 0.005", "heartbeat = 0.5", "watch.heartbeat: expected at most 0.005, got 0.5"),
        ("watchdog         = 0.010", "watchdog = 0.011", "node.watchdog: expected at most 0.01, got 0.011"),
    ]:
        assert old in TEXT
        bench = parse_bench(TEXT.replace(old, long), "t")
        with pytest.raises(BenchFileError) as caught:
            bench.refuse_long_timeouts()
        assert str(caught.value).startswith(message)


def test_the_identity_ignores_time_outs_and_comments_but_not_the_physics(bench: Bench) -> None:
    patient = parse_bench(TEXT.replace("stop_missed  = 20", "stop_missed  = 200"), "t")
    assert patient.identity_hash == bench.identity_hash
    assert parse_bench(TEXT + "\n# a comment\n", "t").identity_hash == bench.identity_hash
    for old, new in [
        ("2.170e-2", "2.171e-2"),
        ("horizon     = 500", "horizon     = 400"),
        ("margin  = 0.3", "margin  = 0.4"),
    ]:
        assert parse_bench(TEXT.replace(old, new, 1), "t").identity_hash != bench.identity_hash


@given(st.data())
def test_a_mutated_bench_is_read_or_refused_and_never_crashes(data: st.DataObject) -> None:
    position = data.draw(st.integers(0, len(TEXT) - 1))
    length = data.draw(st.integers(0, 30))
    insert = data.draw(st.text(max_size=10))
    with suppress(BenchFileError):  # refused is as good as read; any other error fails the test
        parse_bench(TEXT[:position] + insert + TEXT[position + length :], "t")
