"""Hill climbing towards the limits: what the search of ``shield_search.py`` finds by chance, climbed to."""

from __future__ import annotations

import numpy as np

from emb_bench.compiled import compiled
from emb_bench.config.bench import Bench
from emb_runtime.safety.shield_design import ShieldLaw, make_law
from tests.properties.shield_search import (
    AS_PLANNED,
    DAMPED,
    DAMPED_WITHIN,
    EULER,
    FASTEST,
    FINE,
    FREEWHEEL,
    HIGHEST,
    LOST,
    LOWEST,
    OBEYED,
    PLAIN,
    SLOWEST,
    TAIL,
    Floats,
    Script,
    episodes,
)

SWITCHES = 10
GAPS = 3
GENES = 14 + SWITCHES + 2 * GAPS


def climb(
    bench: Bench,
    chains: int,
    generations: int,
    seed: int,
    *,
    law: ShieldLaw | None = None,
    bandwidth: float | None = None,
) -> Floats:
    """Climb towards the limits: each chain changes one episode a little and keeps it if it comes nearer to a limit.

    A chain's genes, all in 0..1, are the brake and its features, the times at which full current switches sign, noise
    at its bound, stretches of lost commands, and which of the brakes and stops it is; its observer, where the bench
    declares one, of this ``bandwidth`` [rad/s] or the declared one.
    """
    law = law or make_law(bench)
    bandwidth = bandwidth or bench.sensors.observer_bandwidth or 0.0
    rng = np.random.default_rng(seed)
    best = rng.random((chains, GENES + (2 if bandwidth else 0)))
    margin = _margins(bench, law, best, bandwidth)
    for _ in range(generations):
        tried = np.where(rng.random(best.shape) < 0.12, best + rng.normal(0.0, 0.15, best.shape), best)
        tried = np.where(rng.random(best.shape) < 0.02, rng.random(best.shape), np.clip(tried, 0.0, 1.0))
        found = _margins(bench, law, tried, bandwidth)
        better = found <= margin
        best[better], margin[better] = tried[better], found[better]
    return margin


def _margins(bench: Bench, law: ShieldLaw, genes: Floats, bandwidth: float) -> Floats:
    m, n = len(genes), law.steps + TAIL // 4
    box, s = bench.range_set(bench.shield.ranges), bench.shield
    low, high = np.array(box.low), np.array(box.high)
    most = np.array([s.current_lag, s.break_away - 1.0, 100.0, s.f_l, 0.0, 0.0, 0.0])
    time = np.arange(n)
    switches = genes[:, 14 : 14 + SWITCHES] * law.steps
    count = (time[None, :, None] >= switches[:, None, :]).sum(axis=2)
    wanted = np.where((count + (genes[:, 8:9] > 0.5)) % 2 == 0, 1.0, -1.0)
    drops = np.full((m, n), OBEYED)
    for gap in range(GAPS):
        begin = genes[:, 14 + SWITCHES + gap] * law.steps
        length = np.floor(8.0 * genes[:, 14 + SWITCHES + GAPS + gap])
        drops[(time >= begin[:, None]) & (time < (begin + length)[:, None])] = LOST
    follows = np.array([-1, 0, 1])[np.minimum(3.0 * genes[:, 9], 2.0).astype(np.int64)]
    errors = np.where(genes[:, None, 10:12] > 0.5, 1.0, -1.0) * np.ones((m, n, 2))
    errors[follows != 0] = 1.0
    solvers, observers = np.where(genes[:, 13] > 0.5, FINE, EULER), np.zeros((m, 3))
    if bandwidth:
        observers[:, 0] = np.where(solvers == FINE, bandwidth, 0.0)
        observers[:, 1] = 0.7 + 0.3 * np.clip(1.5 * genes[:, -2] - 0.25, 0.0, 1.0)
        observers[:, 2] = np.where(genes[:, -1] > 0.5, 0.0, 1.0)
    script = Script(
        brakes=low + np.clip(1.5 * genes[:, :6] - 0.25, 0.0, 1.0) * (high - low),
        wanted=wanted,
        feedback=np.full(m, AS_PLANNED),
        touches=np.ones(m, np.int64),
        errors=errors,
        follows=follows,
        drops=drops,
        ages=np.repeat(np.round(law.age_low + genes[:, 12:13] * (law.age_high - law.age_low)).astype(np.int64), n, 1),
        solvers=solvers,
        features=np.array(PLAIN) + np.clip(1.5 * genes[:, 6:7] - 0.25, 0.0, 1.0) * most,
        plant=bench.plant("exact").mechanics,
        stop=np.full(m, FREEWHEEL) if law.coasting else np.where(genes[:, 7] > 0.5, DAMPED, DAMPED_WITHIN),
        observers=observers,
    )
    rows = np.zeros((m, 9))
    compiled(episodes)(law, script, rows)
    limits = bench.limits
    angle = np.minimum(rows[:, LOWEST] - limits.angle[0], limits.angle[1] - rows[:, HIGHEST])
    speed = limits.velocity - np.maximum(rows[:, FASTEST], -rows[:, SLOWEST])
    return np.minimum(angle, 0.1 * speed)
