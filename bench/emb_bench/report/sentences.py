"""The sentences that texts and pages share: one function each, from a record to English."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence

from emb_bench.analysis.conclusion import Conclusion
from emb_bench.analysis.drift import Drift, Earlier
from emb_bench.analysis.options import names_of
from emb_bench.analysis.records import Candidate, HeldOut, Profile
from emb_bench.analysis.study import Code, Stop, Study, verdict
from emb_bench.brake.parameters import quantity
from emb_bench.config.bench import Bench
from emb_bench.config.machine import Machine
from emb_bench.estimate.effects import EFFECTS, shown_as
from emb_bench.estimate.estimate import OF_THE_BENCH, Estimate
from emb_bench.estimate.records import (
    DONE,
    FEWEST_WINDOWS,
    WITHOUT_GAPS,
    Cause,
    Contribution,
    Derived,
    ModelValidation,
)
from emb_bench.experiment.experiment import Lack
from emb_bench.information.evaluation import default_model
from emb_bench.information.identifiability import Doubt
from emb_bench.numbers import amount, p_value, percent
from emb_bench.report.information import DOUBTS, assumed_currents, doubts, lacks, trade_offs
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.numbers import between, in_percent, plain
from emb_runtime.system.terminal import one_line

INTERVALS = (
    "± 95 % (k=2). Repeatability: scatter of further runs by sensor noise. Total: also systematic errors and effects "
    "that the record cannot exclude."
)

NOISE_ALONE = "± repeatability (95 %, k=2), by sensor noise alone, without systematic or other errors."

TERMS = {
    "sigma": "standard deviation",
    "repeatability": "half of the 95 % interval (k = 2) by sensor noise: the scatter of further runs",
    "total": "half of the 95 % interval (k = 2), also with systematic errors and effects that the record cannot "
    "exclude, where they are allowed for",
    "chi2/n": "mean square of the residuals in sigmas, near 1 if the model is right",
    "identified": "the 95 % interval is closed, excludes zero and ends at no border of the search",
    "trades off": "the data determine two parameters well only together: their errors compensate",
}
"""Terms of the results, each explained in a line."""


LONGEST_NAME = 80  # Characters of a name from another file


def without(study: Study) -> str:
    """Heading of the intervals of a model that does not hold, with the error that they lack."""
    return f"± total (95 %, k=2), without the {'bias of the method' if verdict(study).biased else 'error of the model'}"


def intervals(e: Estimate) -> str:
    """Sentence on the intervals of a right model."""
    if not (e.question.systematic or e.validation.budget):
        return NOISE_ALONE
    return INTERVALS.replace("systematic errors and ", "") if e.ideal_sensors else INTERVALS


def effects(machine: Machine | None) -> dict[str, str]:
    """Effects of the score tests and the uncertainty budget, a line each, by their names in the output."""
    lines = {name: row.effect.removesuffix(",") for name, row in EFFECTS.items()}
    for parameter in PARAMETER_NAMES:
        for name in (parameter, f"{parameter}_drift"):
            lines[name] = lines[name].replace(parameter, quantity(machine, parameter).name)
    return {shown_as(Contribution(name, ()), machine).name: line for name, line in lines.items()}


# ---- the verdict on a study ----


def simulated(study: Study) -> str:
    """Sentence on simulated runs; empty without any."""
    marked = [(run.name, run.log.simulated) for run in study.reported if run.log.simulated]
    if not marked:
        return ""
    where = ", ".join(name for name, _ in marked)
    some = f" in {len(marked)} of {len(study.reported)} runs ({where})" if len(marked) < len(study.reported) else ""
    driven = " and ".join(dict.fromkeys(what for _, what in marked))
    return f"SIMULATED: the values are of {driven}{some}, not of a real machine."


def headline(study: Study) -> str:
    """Verdict on the model, and the worth of its values."""
    code = verdict(study).model
    if code is Code.NO_ESTIMATE:
        return f"NO ESTIMATE: {study.why_not}"
    name, m = study.estimate.plant.name, study.estimate.validation
    size = f" (chi2/n {plain(m.ratio)}, at most {m.expected[1]:.3f} expected)" if "size" in m.alarming else ""
    missed = ", ".join(study.unidentified)
    others = len(study.unidentified) < len(study.estimate.question.params)
    return {
        Code.BIASED_METHOD: f"NO VERDICT: recursive least squares does not reproduce the record (chi2/n "
        f"{plain(m.ratio)}). Noise biases its values; the model is not tested. Use --method oem.",
        Code.DOES_NOT_FIT: f"THE MODEL '{name}' DOES NOT FIT{size}: the intervals do not include its error.",
        Code.DOES_NOT_PREDICT: f"THE MODEL '{name}' DOES NOT PREDICT other records: the values hold only for the "
        "records of the estimate.",
        Code.NOT_IDENTIFIED: f"The model '{name}' fits. NOT identified: {missed}"
        f"{'; the values of the others may be used' if others else ''}.",
        Code.FITS: f"The model '{name}' fits. All parameters are identified: the values may be used.",
    }[code]


ONLY_ALONE = (
    "EACH RUN FITS ALONE, but not all of them together: they are of different brakes, or the brake changed between "
    "them. Use the values of each run, not the common ones"
)


def compared(studies: Sequence[Study]) -> str:
    """Verdict on each of two runs side by side, and the parameters in which they differ."""
    changes = [d for d in studies[1].checks.drifts if d.drifted]
    differ = "; ".join(f"{d.name} {drift(d)}" for d in changes) or "No parameter differs significantly"
    return f"{'; '.join(f'{one.names[0]}: {verdict(one).code.value}' for one in studies)}. {differ}."


def stopped(stop: Stop) -> str:
    """Sentence on the end of a stopped run."""
    after = f" after {stop.periods} of {stop.planned} samples" if stop.planned else ""
    return f"STOPPED: {stop.log}{after} ({stop.reason}){f': {stop.detail}' if stop.detail else ''}"


def outside(study: Study, bench: Bench) -> list[tuple[str, str]]:
    """Names of runs with sentences on parameters outside of the ranges for which the shield guarantees the limits."""
    found = []
    for name, c in study.outside:
        low, high = c.outside or (math.nan, math.nan)
        ranges = f"ranges.{bench.shield.ranges} ({plain(low, 4)} to {plain(high, 4)})"
        line = (
            f"OUTSIDE: {c.label} = {amount(c.value, c.interval, c.unit)} lies outside {ranges}: the limits were not "
            "guaranteed. Find the cause, or widen the range."
        )
        found.append((name, line))
    return found


def apart(study: Study) -> str:
    """Parameters that differ between logs that fit alone."""
    values = "; ".join(f"{d.name}: {', '.join(plain(value, 5) for value in d.values)}" for d in study.checks.apart)
    first = study.checks.apart[0].values
    alone, every = sum(map(math.isfinite, first)), len(first)
    which = "each log fits alone, but not with the others" if alone == every else f"{alone} of {every} logs fit alone"
    return f"{which}: two brakes, or one that changed. By each log: {values}."


def changed_model(study: Study) -> str:
    """A warning that drifts may be the model's, not the brake's; else empty."""
    why = other_model(study.estimate, study.last) if any(d.drifted for d in study.checks.drifts) else ""
    return f"the changes may be the model's: {why}" if why else ""


def other_model(now: Estimate, last: Earlier | None) -> str:
    """Reasons that a change since an earlier estimate may be the model's; empty without any."""
    if last is None:
        return ""
    reasons = {
        "it did not fit then": not last.model_fits,
        "it does not fit now": not now.validation.fits,
        f"it was '{one_line(last.model, LONGEST_NAME)}' then": last.model != now.plant.name,
    }
    return " and ".join(reason for reason, holds in reasons.items() if holds)


def missing(study: Study) -> list[str]:
    """Defects of the logs, except the early end of a stopped run."""
    found = []
    for log, experiment in zip(study.logs, study.estimate.experiments, strict=True):
        defects = [log.missing] if log.missing else []
        stopped = log.end.get("exit_reason", DONE) != DONE
        defects += lacks(experiment, but=(Lack.ENDS_EARLY,) if stopped else ())
        lost = int((~experiment.measured).sum()) - experiment.outliers
        if lost and study.estimate.method in WITHOUT_GAPS:
            defects.append(
                f"this method does not estimate the currents of {lost} periods without report: it assumes the command, "
                "or the node's braking without one; the right model may not fit"
            )
        found.append(defects)
    return _of_which(study, found)


def assumptions(study: Study) -> list[str]:
    """Assumptions about the applied currents that are not the reported ones."""
    return _of_which(study, [assumed_currents(experiment) for experiment in study.estimate.experiments])


def _of_which(study: Study, found: Sequence[Sequence[str]]) -> list[str]:
    """Texts of each log, after its name if there are several."""
    several = len(study.logs) > 1
    pairs = zip(study.names, found, strict=True)
    return [f"{name}: {text}" if several else text for name, texts in pairs for text in texts]


def model_reason(study: Study) -> str:
    """Reason for the model."""
    choice = study.checks.choice
    if choice is None:
        return "as requested" if study.options.model else default_model(study.logs[0])[1]
    why = f"the best of {len(choice.candidates)}"
    same = f"; {', '.join(choice.same)} not ranked: equal to another one with an estimated encoder offset"
    return why + same if choice.same else why


def models(study: Study) -> str:
    """Models that the experiments do not separate; empty with one plausible model."""
    choice = study.checks.choice
    found: Sequence[Candidate] = choice.plausible if choice is not None else ()
    if choice is None or len(found) < 2:
        return ""
    names = ", ".join(c.name for c in found[:-1])
    weights = ", ".join(percent(c.weight) for c in found)
    every = "both" if len(found) == 2 else "all"
    fit = f"{every} fit" if choice.best.fits else "do not fit"
    return (
        f"{names} and {found[-1].name} {fit}, and the records do not separate them (weights {weights}): the "
        f"intervals cover {every}"
    )


def limit(effect: Contribution, e: Estimate) -> str:
    """Name of the effect that widens an interval most; with its prior if all runs share it."""
    name, shared = shown_as(effect, e.bench.machine).name, effect.name in OF_THE_BENCH
    return f"{name}, known to {in_percent(e.question.unmodelled[effect.name])}" if shared else name


# ---- tests on the residuals ----


def alarms(e: Estimate) -> list[str]:
    """Reasons that the model does not fit, the cause first; empty if it fits."""
    m, scored = e.validation, any(name.startswith("score of") for name in e.validation.alarming)
    found = [] if m.fits else faults(e)
    if found:
        pass
    elif m.cause is not None and m.cause.suspect.observer:
        found.append(explained(m.cause, e.bench.machine))
    elif fixed := fixed_parameters(e):
        names = ", ".join(fixed)
        one = f"{names}, which is fixed," if len(fixed) == 1 else f"one of {names}, which are fixed,"
        found.append(f"{one} may explain it; remedy: estimate {_every(e)}: leave --params out")
    elif m.cause is not None:
        found.append(_cause(m.cause, e))
    elif scored:
        found.append("no effect explains the misfit with a possible amount: look for a fault in the data")
    elif m.together is not None and "scores" in m.alarming:
        score = f"chi2 {plain(m.together.statistic, 4)} of {m.together.rank}, {p_value(m.together.p_value)}"
        found.append(f"the model lacks several effects together ({score})")
    depends = [name for name in m.independence if f"current of {name}" in m.alarming]
    if "size" in m.alarming:
        no_pattern = ", without any pattern: the noise may be larger than in the bench file"
        why = "" if depends or m.coloured or scored else no_pattern
        found.append(
            f"the residuals are too large: chi2/n {plain(m.ratio, 4)}, at most {m.expected[1]:.3f} expected{why}"
        )
    for name in depends:
        test = m.independence[name]
        found.append(
            f"the residuals of the {name} depend on the current: F = {plain(test.statistic)}, {p_value(test.p_value)}, "
            f"largest correlation {test.correlation:+.2f} with the current {test.lag} periods earlier"
        )
    if any(f"whiteness of {name}" in m.alarming for name in m.coloured):
        found.append(f"{_coloured(m)}: the disturbance of the brake or its sensors is not white, or the model is wrong")
    return found


def _cause(cause: Cause, e: Estimate) -> str:
    """The cause of a misfit with its remedy, and the advice to check the data for an impossible amount."""
    sentence = explained(cause, e.bench.machine)
    sentence += _window(e) if "--nuisance" in sentence else ""
    return sentence if cause.possible else f"{sentence}; or look for a fault in the data"


def _window(e: Estimate) -> str:
    """Option for enough windows with two more unknowns; empty if there are enough, or no windows."""
    machine, needed = e.bench.machine, FEWEST_WINDOWS * (len(e.unknowns) + 2)
    if machine is None or not 0 < e.windows < needed:
        return ""
    longest = (e.question.window or machine.window) * e.windows / (needed + 1)
    return f" --window {math.floor(1e3 * longest) / 1e3:g}"


def faults(e: Estimate) -> list[str]:
    """Faults of recordings of others and their maps."""
    return [fault for experiment in e.experiments for fault in experiment.quality.faults]


def fixed_parameters(e: Estimate) -> list[str]:
    """Parameters without an estimate, each of which may explain a misfit; most significant first."""
    cause = e.validation.cause
    return [] if cause is None else [quantity(e.bench.machine, name).name for name in cause.fixed]


def _every(e: Estimate) -> str:
    return "all four" if e.bench.machine is None else "all parameters"


def residual_notes(e: Estimate) -> list[str]:
    """Remarks on the residuals that do not reject the model."""
    m, found = e.validation, list[str]()
    if m.disturbance is not None:
        walks = " and ".join(random_walks(e.bench.machine, m.disturbance.walk, m.disturbance.load))
        found.append(
            f"the {'brake' if e.bench.machine is None else 'machine'} is disturbed by more than the sensors' noise: "
            f"{walks} (likelihood ratio {plain(m.disturbance.ratio, 4)}, {p_value(m.disturbance.p_value)}); the "
            "intervals include it"
        )
    if m.ratio < m.expected[0]:
        found.append(
            f"the residuals are smaller than the bench's noise: chi2/n {plain(m.ratio, 4)}, at least "
            f"{m.expected[0]:.3f} expected: the noise in the bench file, and all uncertainties, are too large"
        )
    if m.coloured and not any(f"whiteness of {name}" in m.alarming for name in m.coloured):
        found.append(
            f"{_coloured(m)}: if only the sensors are disturbed, the model may be right, but the standard deviations "
            "by Fisher information are wrong"
        )
    return found


def random_walks(machine: Machine | None, velocity: float, load: float) -> list[str]:
    """Random walks of a disturbed machine, of its velocity and of its load, except those of size 0."""
    found, command = list[str](), quantity(machine, "current")
    if velocity > 0.0:
        unit = quantity(machine, "velocity").unit
        found.append(f"its velocity has a random walk of {plain(velocity)} {unit} per root of a second")
    if load > 0.0:
        size = f"{plain(load)} {command.unit}".removesuffix(" 1")
        found.append(f"its load has a random walk, that of a {command.name} of {size} per root of a second")
    return found


def _coloured(m: ModelValidation) -> str:
    tested = "; ".join(
        f"{plain(white.statistic, 4)} at {white.lags} lags, {p_value(white.p_value)}"
        for white in (m.whiteness[name] for name in m.coloured)
    )
    return f"the residuals of the {' and '.join(m.coloured)} are correlated in time (Ljung-Box {tested})"


def explained(cause: Cause, machine: Machine | None = None) -> str:
    """A cause with its remedy; ``machine`` is that of a bench without a brake.

    With the amount only if the effect is no curve and explains all of the misfit by a possible amount: elsewhere a
    linear score test gives it unreliably.
    """
    s = cause.suspect
    if s.observer:
        return derived_velocity(s.observer, machine)
    effect, unit = EFFECTS[s.name], shown_as(s, machine).unit
    name, is_part = effect.effect, cause.share is not None and cause.share < 1.0
    for parameter in PARAMETER_NAMES:
        name = name.replace(parameter, quantity(machine, parameter).name)
    if cause.is_curve:
        name = "a stiffness with a quadratic and a cubic term"
    elif s.possible and cause.share == 1.0:
        name += f" of about {plain(s.value, 2)} {unit}" if unit else f" of about {in_percent(s.value)}"
    remedy = effect.remedy
    if machine is not None and "--model" in remedy:  # the plant of a recording is that of its map
        remedy = "leave [signals.velocity] out of the map"
    if cause.share is None:
        does = "is the most significant"
    else:
        does = f"explains {percent(cause.share)} of the misfit" if is_part else "explains the misfit"
    return f"{name} {does} ({cause.sigmas:.0f} sigma); remedy: {remedy}"


def derived_velocity(observer: Derived, machine: Machine | None) -> str:
    """An observer that is not declared; ``machine`` as for :func:`explained`."""
    best, least, declared = (float(f"{w:.2g}") for w in (observer.bandwidth, observer.least, 0.9 * observer.least))
    bandwidth = f"about {best:g}" if observer.is_known else f"at least {least:g}"
    remedy = (
        f'declare it ([sensors] velocity = "observer", observer_bandwidth = {declared:g}) in a bench file: --bench FILE'
        if machine is None
        else "leave its column out of the map"
    )
    return f"the velocity is derived from the angle, bandwidth {bandwidth} rad/s: {remedy}"


# ---- parameters ----


def conclusion(c: Conclusion) -> str:
    """Value, interval and standing of a parameter, its trade-offs and its change."""
    standing = ": ".join(filter(None, (c.standing.value, doubts(c.finding))))
    change = "" if c.drift is None else drift(c.drift)
    return "; ".join(filter(None, (amount(c.value, c.interval, c.unit), standing, trade_offs(c.finding), change)))


def clamping(study: Study) -> str:
    """Clamping force, the current that holds it and its friction band; empty if a parameter is not identified."""
    if (found := study.clamping) is None:
        return ""
    _, force, current, friction = found
    total, band = (in_percent(one.total / one.value) for one in (force, friction))
    return (
        f"clamping    force known to {total}: {amount(*force.with_interval)} at {plain(found.angle)} rad, held by "
        f"{amount(*current.with_interval)}; friction band ± {plain(friction.value)} N, known to {band}"
    )


def drift(d: Drift) -> str:
    """Change of a parameter since an earlier estimate."""
    since = "the last estimate" if not d.since else d.since[0]
    since += f" and {len(d.since) - 1} more" if len(d.since) > 1 else ""
    if math.isinf(d.detectable):
        return f"cannot be compared with {since}: not identified {'then' if math.isinf(d.last_deviation) else 'now'}"

    def size(change: float) -> str:
        return in_percent(change) if d.relative else plain(change, 2)

    if not d.drifted:
        return f"no significant change since {since} (detection limit {size(d.detectable)})"
    way = "rose" if d.sigmas > 0 else "fell"
    sigmas = f"{abs(d.sigmas):{'.2g' if abs(d.sigmas) < 10.0 else '.0f'}}"
    return f"{way} by {size(abs(d.relative_change))} ({sigmas} sigma) since {since}"


def held_out(h: HeldOut) -> str:
    """Prediction of one experiment."""
    return (
        f"{'predicted' if h.fits else 'NOT predicted'}, chi2/n {plain(h.ratio, 4)} of {h.freedom}, {p_value(h.p_value)}"
    )


def profile(p: Profile, e: Estimate) -> str:
    """Interval of a likelihood profile, compared with that of the Fisher information."""
    (low, high), fisher = p.interval, p.fisher
    name = e.quantities[e.labels.index(p.label)].unit
    unit = "" if name == "1" else f" {name}"
    if p.doubt is Doubt.CUT:
        comparison = DOUBTS[Doubt.CUT]
    elif math.isinf(low) and math.isinf(high):
        comparison = "flat: the records exclude no value within the search"
    elif math.isinf(low):
        comparison = f"only values above {plain(high, 4)}{unit} are excluded"
    elif math.isinf(high):
        comparison = f"only values below {plain(low, 4)}{unit} are excluded"
    elif math.isinf(fisher[1]):
        comparison = f"{between(low, high)}{unit}; the Fisher information gives no bound"
    elif p.agrees:
        comparison = f"{between(low, high)}{unit}; the Fisher information gives the same interval"
    else:
        comparison = f"{between(low, high)}{unit}; by the Fisher information {between(*fisher)}{unit}"
    found = [comparison]
    if e.method != "oem":
        found.append(f"of output error, whose minimum is at {plain(p.minimum, 6)}{unit}")
    if p.fell:
        found.append(f"chi2 fell by {plain(p.fell)} at {plain(p.minimum, 6)}{unit}: the estimate is a local minimum")
    if not e.validation.fits:
        found.append("too narrow, because the model does not fit")
    return "; ".join(found)


def prior(e: Estimate) -> str:
    """Prior knowledge; empty without any."""
    ranges = e.question.prior
    return "" if ranges is None else f"the ranges '{ranges.name}', as a Gaussian of their mean and variance"


def once(study: Study) -> str:
    """A warning that only one of several searches found the best minimum; else empty."""
    found = study.minima
    lonely = len(study.estimate.ends) > 1 and bool(found) and len(found[0]) == 1
    return "the best minimum was found by one search only: use more --starts" if lonely else ""


def pairs(found: Sequence[str]) -> str:
    """Pairs of parameters that are strongly correlated."""
    return f"strongly correlated: {'; '.join(found)}"


# ---- what to do next ----


MORE = "run emb-run, whose actor excites all four parameters, and estimate from all logs together"


def logs_of(study: Study) -> str:
    """Logs of a study as arguments of a command."""
    end = "" if study.estimate.bench.machine is None else " --map MAP"
    paths = [shlex.quote(str(log.path)) for log in study.logs[:3]]
    return " ".join(paths) + (" ..." if len(study.logs) > 3 else "") + end


def remedies(study: Study, *, stopped: bool) -> list[str]:
    """Remedies for a model that does not fit or predict, and for unidentified parameters.

    If a run was ``stopped``, no further run is suggested.
    """
    e, again = study.estimate, f"emb-replay estimate {logs_of(study)}{_known(study)}"
    if verdict(study).biased:
        return [f"use another method: {again} --method oem"]
    if study.model_fits and not study.checks.predicts:
        return ["find the difference between the runs: the brake, its homing (--nuisance offset); or use --model"]
    if study.checks.apart:
        return [f"estimate from each log alone: emb-replay campaign {logs_of(study)} -o rows.csv"]
    if study.model_fits:
        if stopped or not study.unidentified or e.bench.machine is not None:
            return []
        weak = [c.label for c in study.conclusions if not (c.of_interest or c.identified)]
        return [f"estimate without {', '.join(weak)}: not determined by the record"] if weak else [MORE]
    if faults(e):
        return ["correct the map by the first line, and estimate again: no value is usable before"]
    found = []
    if fixed_parameters(e):
        found.append(f"estimate {_every(e)}: {again}{_options(study)}")
    otherwise = "if that does not fit either, " if found else ""
    if e.bench.machine is None:
        found.append(f"{otherwise}find a model that explains the record: {again} --model all")
    else:
        if border := [c.label for c in study.conclusions if Doubt.AT_BORDER in c.finding.doubts]:
            found.append(f"enter another guess of {', '.join(border)} in the map: a factor of 10 about it is searched")
        found.append(f"{otherwise}estimate what the model lacks, too: {again} --nuisance NAME")
    if e.method == "oem":
        found.append(f"if that does not help, allow for a disturbance: {again} --method pem")
    return found


def _known(study: Study) -> str:
    """The option --known of a study, as given."""
    given = ",".join(names_of(study.options.known or ()))
    return f" --known {given}" if given else ""


def _options(study: Study) -> str:
    """Options of a study without those that name unknowns."""
    options, usual = study.options, "oem" if study.estimate.bench.machine is None else "windows"
    given = {"--method": "" if options.method in (None, usual) else options.method, "--model": options.model or ""}
    return "".join(f" {option} {value}" for option, value in given.items() if value)
