"""Conclusion of a comparison in words: the first candidate against the others, and whether learning was worth it."""

from __future__ import annotations

import math

from emb_bench.numbers import Score
from studies.comparison.comparison import Comparison, Pair, Standing, varied


def number(value: float, digits: int = 3) -> str:
    """To so many significant digits, without an exponent as long as it is short without."""
    if not math.isfinite(value):
        return "-" if math.isnan(value) else str(value)
    rounded = float(f"{value:.{digits}g}")
    return f"{rounded:.12g}" if 1e-3 <= abs(rounded) < 1e7 or rounded == 0.0 else f"{rounded:.{digits - 1}e}"


def interval(score: Score, factor: float = 1.0, digits: int = 3) -> str:
    """``0.4 [0.3, 0.6]``."""
    if math.isnan(score.value):
        return "-"
    low, high = (number(factor * v, digits - 1) for v in (score.low, score.high))
    return f"{number(factor * score.value, digits)} [{low}, {high}]"


def against(c: Comparison) -> list[str]:
    """The first candidate against each other one, a sentence for each; none without a plant that is the model."""
    others = [[pair for pair in c.pairs if pair.other == other.name] for other in c.candidates[1:]]
    return [_sentence(c, pairs) for pairs in others if pairs]


def _sentence(c: Comparison, pairs: list[Pair]) -> str:
    parts = []
    for sign, word in ((-1, "better"), (1, "worse"), (0, "not told apart")):
        if these := [_in(pair) for pair in pairs if pair.sign == sign]:
            parts.append(f"{word} in {', '.join(these)}")
    return f"{c.candidates[0].name} against {pairs[0].other}: {'; '.join(parts)}"


def _in(pair: Pair) -> str:
    if pair.first_tells and pair.other_tells:
        return f"{pair.parameter} ({interval(pair.ratio)} x)"
    if not pair.first_tells and not pair.other_tells:
        return f"{pair.parameter} (which neither tells)"
    return f"{pair.parameter} (which only one of them tells)"


def conclude(c: Comparison) -> list[str]:
    """The verdict, a sentence or two for each thing that it stands on; the last ones are the answer.

    Returns:
        Nothing if there is nothing to compare with, or no plant that is the model.
    """
    if len(c.candidates) < 2 or c.matched is None:
        return []
    standings = c.standings[c.asked.model]
    lines = [_counted(c), *(_ranked(c, standings, j) for j in range(len(c.asked.params))), _information(standings)]
    lines += [_limits(c, standings), *_mismatched(c)]
    return [*lines, *_trained(c), _answer(c)] if c.candidates[0].learned else lines


def _counted(c: Comparison) -> str:
    better, worse, same = (sum(pair.sign == sign for pair in c.pairs) for sign in (-1, 1, 0))
    return (
        f"{c.candidates[0].name} against {len(c.candidates) - 1} others in {', '.join(c.asked.params)}: better in "
        f"{better} of {len(c.pairs)} comparisons, worse in {worse}, not told apart in {same} (each at 95 %, so that "
        "chance alone decides one in twenty)."
    )


def _ranked(c: Comparison, standings: tuple[Standing, ...], j: int) -> str:
    name = c.asked.params[j]
    told = [s for s in standings if s.parameters[j].told > 0.5]
    if not told:
        return f"{name}: nobody tells it."
    order = sorted(told, key=lambda s: s.parameters[j].median.value)
    best, first = order[0], standings[0]
    said = f"{name}: the smallest median error is that of {best.candidate.name}, {_millionths(best, j)}"
    if first not in order:
        return f"{said}; {first.candidate.name} does not tell it."
    place = order.index(first) + 1
    if place == 1:
        return f"{said}."
    times = first.parameters[j].median.value / best.parameters[j].median.value
    place_of = f"{first.candidate.name} is number {place} of {len(standings)}"
    return f"{said}; {place_of}: {_millionths(first, j)}, {times:.2g} x."


def _millionths(standing: Standing, j: int) -> str:
    return f"{number(1e6 * standing.parameters[j].median.value)} ppm"


def _information(standings: tuple[Standing, ...]) -> str:
    first = standings[0]
    if math.isnan(first.of_best.value):
        return f"Information: {first.candidate.name} is stopped on every brake."
    best = max((s for s in standings if not math.isnan(s.of_best.value)), key=lambda s: s.of_best.value)
    said = f"Information: {first.candidate.name} has {100.0 * first.of_best.value:.3g} % of the best in each run"
    if best is not first:
        said += f", {best.candidate.name} {100.0 * best.of_best.value:.3g} %"
    if math.isfinite(first.of_known.value):
        said += f"; of the best design found for the brake if it were known, {interval(first.of_known, 100.0)} %"
        if best is not first:
            said += f" and {interval(best.of_known, 100.0)} %"
    return f"{said}."


def _limits(c: Comparison, standings: tuple[Standing, ...]) -> str:
    first, brakes = standings[0], c.asked.brakes
    under = (
        f"runs of {stopped} of {brakes} brakes"
        if (stopped := _stopped(standings))
        else f"no run on any of {brakes} brakes (at most {100.0 * first.stopped.high:.2g} %)"
    )
    free = f"runs of {first.candidate.name} on {100.0 * first.stopped_free.value:.3g} % of them"
    kept = [s.candidate.name for s in standings if s.stopped_free.value == 0.0]
    never = f", and of {', '.join(kept)} on none" if kept else ", and of everybody on some"
    return f"Limits: under the shield the bench stops {under}; without it {free}{never}."


def _stopped(standings: tuple[Standing, ...]) -> str:
    """Returns the candidates that leave the limits under the shield, and on how many brakes; empty if none does."""
    return ", ".join(
        f"{s.candidate.name} on {100.0 * s.stopped.value:.3g} %" for s in standings if s.stopped.value > 0.0
    )


def _mismatched(c: Comparison) -> list[str]:
    matched, lines = c.standings[c.asked.model], []
    for plant, standings in c.standings.items():
        if plant == c.asked.model:
            continue
        times = [
            wrong.median.value / right.median.value
            for s, m in zip(standings, matched, strict=True)
            for wrong, right in zip(s.parameters, m.parameters, strict=True)
            if right.median.value > 0.0 and right.told > 0.5 and not math.isnan(wrong.median.value)
        ]
        stopped = f"under the shield the bench stops runs of {who} of them" if (who := _stopped(standings)) else ""
        alarms = [s.alarms.value for s in standings if not math.isnan(s.alarms.value)]
        if not alarms:
            lines.append(f"On {plant} brakes nothing is estimated: {stopped}.")
            continue
        often = "all runs" if min(alarms) == 1.0 else f"{100.0 * min(alarms):.3g} % of runs or more, by excitation"
        said = f"On {plant} brakes, estimated as {c.asked.model}, the alarm is raised in {often}"
        if times:
            between = f"{number(min(times), 2)} to {number(max(times), 2)} x that on {c.asked.model} ones"
            said += f"; the median error is {between}, by excitation and parameter"
        if stopped:
            said += f", on brakes where it is never stopped; {stopped}"
        lines.append(f"{said}.")
    return lines


def _trained(c: Comparison) -> list[str]:
    first, differ = c.candidates[0], varied(c.bench, c.asked.ranges)
    others = [name for name in differ if name not in first.trained]
    if not others:
        return []
    known = ", ".join(first.trained) or "nothing"
    return [
        f"{first.name} was trained on brakes that differ in {known}; here they differ in {', '.join(others)} as well."
    ]


def _answer(c: Comparison) -> str:
    """Verdict on the learned excitation against those that need no training."""
    first, params = c.candidates[0].name, c.asked.params
    plain = [other.name for other in c.candidates[1:] if not other.learned]
    signs = {name: {pair.parameter: pair.sign for pair in c.pairs if pair.other == name} for name in plain}
    if not plain:
        return f"Whether learning was worth it cannot be said: all that {first} was compared with is learned too."
    within = f"for {', '.join(params)} on brakes that differ in {', '.join(varied(c.bench, c.asked.ranges))}"
    dominant = [n for n in plain if min(signs[n].values()) >= 0 and max(signs[n].values()) > 0]
    if dominant:
        return (
            f"Is the learned excitation worth it, {within}? No: {', '.join(dominant)} "
            f"{'needs' if len(dominant) == 1 else 'need'} no training, {'is' if len(dominant) == 1 else 'are each'} "
            f"better than {first} in some parameter, and worse in none as far as it can be told."
        )
    best_in = [p for p in params if all(signs[n][p] < 0 for n in plain)]
    if len(best_in) == len(params):
        return f"Is the learned excitation worth it, {within}? Yes: {first} is better than each without training."
    if best_in:
        return (
            f"Is the learned excitation worth it, {within}? Only for {', '.join(best_in)}, where each other is worse."
        )
    level = {p: [n for n in plain if signs[n][p] >= 0] for p in params}
    listed = "; ".join(f"{', '.join(names)} in {p}" for p, names in level.items())
    return (
        f"Is the learned excitation worth it, {within}? Not shown: in no parameter is {first} better than all "
        f"that need no training: not told apart or better {'is' if len(level) == 1 else 'are'} {listed}."
    )
