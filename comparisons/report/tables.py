"""The tables of a report, written once: as HTML, Markdown, LaTeX and CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from nocl.comparisons.report.explain import worst_states
from nocl.comparisons.report.findings import quantiles
from nocl.comparisons.report.results import Results, cells, columns, notes, number, percent
from nocl.support.checks import Array

WORST = 5


@dataclass(frozen=True)
class Table:
    """Cells as text; `text`: a table of words, which wrap, and not of numbers."""

    title: str
    head: Sequence[str]
    body: Sequence[Sequence[str]]
    note: str = ""
    text: bool = False

    def html(self) -> str:
        """It scrolls within itself on a narrow screen."""
        heads = "".join(f"<th>{escape(h)}</th>" for h in self.head)
        lines = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in line) + "</tr>" for line in self.body)
        note = f"<p class=note>{escape(self.note)}</p>" if self.note else ""
        return (f"<div class=scroll tabindex=0><table{' class=text' if self.text else ''}><thead><tr>{heads}</tr>"
                f"</thead><tbody>{lines}</tbody></table></div>{note}")

    def markdown(self) -> str:
        rule = ["---", *(["---" if self.text else "---:"] * (len(self.head) - 1))]
        lines = [self.head, rule, *self.body]
        rows = ["| " + " | ".join(_markdown(cell) for cell in line) + " |" for line in lines]
        return "\n".join([*rows, *(["", _markdown(self.note)] if self.note else [])])

    def latex(self) -> str:
        """A tabular that needs no package."""
        columns = "l" + ("l" if self.text else "r") * (len(self.head) - 1)
        lines = [" & ".join(map(_latex, line)) + r" \\" for line in (self.head, *self.body)]
        return "\n".join([f"% {' '.join(self.title.split())}", rf"\begin{{tabular}}{{{columns}}}", r"\hline", lines[0],
                          r"\hline", *lines[1:], r"\hline", r"\end{tabular}", ""])

    def csv(self) -> str:
        file = io.StringIO()
        csv.writer(file, lineterminator="\n").writerows([self.head, *self.body])
        return file.getvalue()


def _markdown(text: str) -> str:
    return "".join("\\" + c if c in "\\|<*_`" else c for c in " ".join(text.split()))


_LATEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$",
          "<": r"\textless{}", ">": r"\textgreater{}", **{c: "\\" + c for c in "&%$#_{}"}}


def _latex(text: str) -> str:
    return "".join(_LATEX.get(c, c) for c in text)


def tables(report: Results) -> dict[str, Table]:
    """All tables by the name of their file; those of a study where it was made."""
    made: dict[str, Callable[[Results], Table]] = {
        "summary": summary, "errors": errors, "worst": worst, "timings": timings, "audits": audits,
        "robustness": robustness, "promises": promises, "stability": stability, "regions": regions,
        "failures": failures, "impossible": impossible}
    found = {name: make(report) for name, make in made.items()}
    return {name: table for name, table in found.items() if table.body}


NAMES = ("summary", "errors", "worst", "timings", "audits", "robustness", "promises", "stability", "regions",
         "failures", "impossible")  # the names that `tables` may use


def summary(report: Results) -> Table:
    rows = report.summary()
    of = columns(rows)
    return Table("Summary", [label for label, _, _ in of], [cells(row, of) for row in rows], " ".join(notes(report)))


def errors(report: Results) -> Table:
    """By coordinate, in its unit."""
    s = report.ocp.system
    body = []
    for j in report.judged if report.ocp.has_goal else ():
        away = report.ocp.from_goal(j.simulation.x[:, -1], report.parameters)
        error = np.abs(away)[np.asarray(j.simulation.success, dtype=bool)]
        if len(error):
            body.append([j.name, *(f"{number(np.median(e))}, {number(np.max(e))}" for e in error.T)])
    return Table("Terminal error of each coordinate", ["method", *map(s.unit, s.state_names)], body,
                 "|x(T) - x*| by coordinate: median, largest; over the runs that did not fail.")


def worst(report: Results) -> Table:
    head = ["state", "x0", *(f"{j.name}: cost (gap)" for j in report.judged), "best known by"]
    body = []
    for i in worst_states(report)[:WORST]:
        runs = [run_cell(report, m, i) for m in range(len(report.judged))]
        body.append([str(i), x0_text(report, i), *runs, report.best_method[i] or "nobody"])
    return Table("The worst initial states", head, body, text=True)


def x0_text(report: Results, i: int) -> str:
    """Like 'p 0.1, v -0.2, mass 1.1', without what is the same in all states."""
    starts = report.starts
    moves = (starts != starts[0]).any(axis=0) | (len(starts) == 1)
    named = zip(report.start_names, starts[i], moves, strict=True)
    return ", ".join(f"{name} {number(v)}" for name, v, moved in named if moved)


def run_cell(report: Results, m: int, i: int) -> str:
    s = report.judged[m].simulation
    if not s.success[i]:
        return failure(report, m, i)
    return f"{number(report.cost[m, i])} ({percent(report.gap[m, i])} %)"


def failure(report: Results, m: int, i: int) -> str:
    """Why a run that failed did, in words."""
    s = report.judged[m].simulation
    return str(s.message[i]) if s.reached[i] else f"failed: {s.message[i]}"


def timings(report: Results) -> Table:
    head = ["method", "first answer: median", "p95 [ms]", "each later control: median", "p95 [ms]", "solves a state",
            "evaluations of f: median"]
    body = [[j.name, *_median_p95(j.ms_first), *_median_p95(j.ms_per_control), number(float(np.mean(j.solves))),
             number(_quantile(j.evaluations, "p50"))] for j in report.judged]
    return Table("Timings", head, body, "Milliseconds of wall time on this machine, in this process or a worker. An "
                 "evaluation of f is one with its derivatives, as a solver needs it; a feedback law needs none.")


def _median_p95(values: Array) -> list[str]:
    return [number(_quantile(values, "p50")), number(_quantile(values, "p95"))]


def _quantile(values: Array, q: str) -> float:
    known = np.asarray(values, dtype=float)
    return quantiles(known).get(q, math.nan)


AUDITED = (("exploitation", "exploitation %"), ("discretisation", "discretisation %"),
           ("value_error", "|V - J|"), ("gradient_angle", "angle of grad V [deg]"),
           ("gradient_size", "size of grad V [%]"), ("path_gradient_angle", "angle along the path"),
           ("path_gradient_size", "size along the path"), ("hjb", "mean |HJB|"),
           ("hamiltonian_gradient", "mean ||dH/du||"), ("doubt", "model doubtful % of nodes"))


def audits(report: Results) -> Table:
    """Median and 95th percentile of each number of an audit that a method has."""
    found = [audit.summary() for audit in report.audits]
    shown = [(key, label) for key, label in AUDITED if any(row.get(key) for row in found)]
    body = [[row["method"], *(_spread(row.get(key, {})) for key, _ in shown)] for row in found]
    return Table("Audit: models, integrators and value functions", ["method", *(label for _, label in shown)], body,
                 "Median (95th percentile). Exploitation: what the judged cost exceeds the cost on the learned model "
                 "by; discretisation: likewise RK4. grad V is held against a solver's costate."
                 + "".join(f" {audit.sentence}" for audit in report.audits if audit.sentence))


def _spread(found: dict[str, float]) -> str:
    return f"{number(found['p50'])} ({number(found['p95'])})" if found else "-"


def robustness(report: Results) -> Table:
    rows = [] if report.robustness is None else report.robustness.summary()
    body = [[row["scenario"], row["method"], row["how"], str(row["failures"]),
             *(percent(row["lost"].get(q, math.nan)) for q in ("p5", "p50", "p95"))] for row in rows]
    return Table("Robustness: cost lost", ["scenario", "method", "how", "failed", "p5 %", "median %", "p95 %"], body,
                 "Lost: against the optimum solved anew under the same disturbance. A failure counts as infinite.")


def promises(report: Results) -> Table:
    body = [[p.method, "constraints held" if p.within is None else f"{p.within:g} %", f"{p.successes} of {p.n}",
             f"{100 * p.confidence:g} %", f"{math.floor(1000 * p.share) / 10:g} %"] for p in report.promises]
    return Table("What can be promised", ["method", "within", "seen", "confidence", "at least"], body,
                 "Exact lower bound (Clopper and Pearson 1934) of the share of initial states, drawn as these were, "
                 "that end within so much of the best known cost, or with all constraints held.")


def stability(report: Results) -> Table:
    body = [[s.method, s.where, number(s.t), number(s.abscissa), number(float(np.median(s.growth))),
             number(float(s.growth.max()))] for s in report.stability]
    return Table("Local stability", ["method", "where", "t", "largest real part", "growth to T: median", "largest"],
                 body, "Eigenvalues of A + B K, frozen at t, beside the growth of a small disturbance from t to the "
                 "horizon, which is exact: for a policy of a finite horizon eigenvalues alone prove nothing.")


def regions(report: Results) -> Table:
    body = [[r.method, f"{scale:g}", f"{k} of {r.n}", f"{100 * low:.1f} % to {100 * high:.1f} %"]
            for r in report.regions for scale, k, low, high in zip(r.scale, r.successes, r.lower, r.upper, strict=True)]
    return Table("Region of initial states", ["method", "scale of the spread", "succeeded", "share, with its bounds"],
                 body)


def failures(report: Results) -> Table:
    """All failures with their messages, from states that count."""
    body = [[j.name, str(i), str(j.simulation.message[i])] for j in report.judged for i in range(len(report.x0))
            if report.counted[i] and not j.simulation.success[i]]
    return Table("What failed", ["method", "state", "message"], body, text=True)


def impossible(report: Results) -> Table:
    """The states that do not count, and why."""
    body = [[str(i), x0_text(report, i), report.impossible[i]] for i in np.flatnonzero(~report.counted).tolist()]
    return Table("Left out: no plan holds the constraints", ["state", "x0", "why"], body,
                 "By DDP, from cold starts and from what the methods did: the word of a local solver.", text=True)


def facts(pairs: Iterable[tuple[str, object]]) -> Table:
    """Names and values."""
    return Table("", ["", ""], [[key, str(value)] for key, value in pairs], text=True)
