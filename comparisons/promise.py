"""What can be promised from n independent initial states: exact binomial bounds.

Clopper, Pearson (1934), "The use of confidence or fiducial limits illustrated in the case of the binomial",
Biometrika 26(4): the bounds hold for every n and share, with at least the confidence that they claim.
"""

from __future__ import annotations

from nocl.comparisons.report.findings import Promise
from nocl.comparisons.report.report import Report
from nocl.comparisons.report.results import REFERENCE

WITHIN = 2.0  # per cent of the best known cost
CONFIDENCE = 0.99


def lower_bound(successes: int, n: int, confidence: float) -> float:
    """The largest share p0 that `confidence` allows to claim: P(at least so many successes | p0) = 1 - confidence."""
    from scipy.stats import beta

    _check(successes, n, confidence)
    return 0.0 if successes == 0 else float(beta.ppf(1 - confidence, successes, n - successes + 1))


def interval(successes: int, n: int, confidence: float) -> tuple[float, float]:
    """Two-sided bounds of the share, each missed with probability (1 - confidence) / 2 at most."""
    one_sided = (1 + confidence) / 2
    return lower_bound(successes, n, one_sided), 1 - lower_bound(n - successes, n, one_sided)


def promises(report: Report, within: float = WITHIN, confidence: float = CONFIDENCE) -> tuple[Promise, ...]:
    """One promise a method, and on a problem with constraints one more, that it holds them. Empty where the states were
    given: they need to be independent draws. States from which no plan is known that holds the constraints, as a local
    solver says, are none of those meant.

    A state counts where the run violates nothing and costs at most `within` per cent more than the best known cost,
    over all methods here and simple baselines: it is a statement about that cost, not about an optimum that nobody
    found.
    """
    n = int(report.counted.sum())
    if report.settings.get("seed") is None or not n:
        return ()
    of = "initial states and parameters of these distributions" if report.ocp.np else Promise.of
    of += "" if report.counted.all() else " from which a plan that holds the constraints is known"
    kept = {within: report.within(within)} | ({None: report.feasible} if report.ocp.constraint_names else {})
    return tuple(Promise(j.name, what, confidence, n, int(good[m].sum()),
                         lower_bound(int(good[m].sum()), n, confidence), of)
                 for what, good in kept.items() for m, j in enumerate(report.judged) if j.name != REFERENCE)


def _check(successes: int, n: int, confidence: float) -> None:
    if not 0 <= successes <= n or n < 1:
        raise ValueError(f"{successes} successes of {n}; expected 0 <= successes <= n and n >= 1")
    if not 0 < confidence < 1:
        raise ValueError(f"confidence is {confidence!r}; expected a number between 0 and 1, like 0.99")
