"""Table I as Markdown, LaTeX, CSV and a figure: ours over the seeds, the paper's numbers beside it."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from nocl.comparisons.reproduce.sysid import SYSTEMS, WAYS, Cell, Entry, published, table
from nocl.support import store

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Table = Mapping[tuple[str, str], Entry]


def write(folder: str | Path, cells: Sequence[Cell]) -> list[Path]:
    """sysid.md, .tex, .csv and .png in the folder; their paths."""
    from nocl.comparisons.report.style import encode

    entries, folder = table(cells), Path(folder)
    texts = {"md": markdown(entries), "tex": latex(entries), "csv": as_csv(entries)}
    paths = [store.write_text(folder / f"sysid.{kind}", text) for kind, text in texts.items()]
    return [*paths, store.write_bytes(folder / "sysid.png", encode(figure(entries), "png"))]


def _systems(entries: Table) -> list[str]:
    return [s for s in SYSTEMS if any(system == s for system, _ in entries)]


def _number(x: float) -> str:
    """Three digits, plain where it is readable."""
    return f"{x:.3g}" if 1e-4 <= abs(x) < 1e4 or x == 0 else f"{x:.1e}".replace("e-0", "e-")


def markdown(entries: Table) -> str:
    """A block of rows for each system: ours, the spread over seeds, the paper's."""
    lines = ["| system | network | steps x batch, width; seconds | mean ± s.d. | median (iqr) | mean of the seeds "
             "| paper: mean ± s.d. | paper: median (iqr) | ours / paper's |", f"|{'---|' * 9}"]
    for system in _systems(entries):
        for way in WAYS:
            entry, paper = entries.get((system, way.name)), published(system, way.name)
            if entry is None:
                continue
            theirs = ["", "", ""] if paper is None else [
                f"{_number(paper[0])} ± {_number(paper[1])}", f"{_number(paper[2])} ({_number(paper[3])})",
                f"{entry.mean / paper[0]:.2f}"]
            cells = [system, way.title, f"{entry.made}; {entry.seconds:.0f}".lstrip("; "),
                     f"{_number(entry.mean)} ± {_number(entry.std)}",
                     f"{_number(entry.median)} ({_number(entry.iqr)})",
                     f"{_number(entry.lowest)} .. {_number(entry.highest)}", *theirs]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def latex(entries: Table) -> str:
    """In the form of the paper: ways down, systems across; the paper's own numbers in grey below ours."""
    systems = _systems(entries)
    head = " & ".join(rf"\multicolumn{{2}}{{c}}{{{s}}}" for s in systems)
    lines = [rf"\begin{{tabular}}{{l{'cc' * len(systems)}}}", r"\toprule", rf" & {head} \\",
             " & " + " & ".join([r"mean (s.d.) & median (iqr)"] * len(systems)) + r" \\", r"\midrule"]
    for way in WAYS:
        ours, theirs = [way.title], [r"\quad paper"]
        for system in systems:
            entry, paper = entries.get((system, way.name)), published(system, way.name)
            ours += ["--", "--"] if entry is None else _pair((entry.mean, entry.std, entry.median, entry.iqr))
            theirs += ["", ""] if paper is None else [rf"\color{{gray}}{text}" for text in _pair(paper)]
        lines.append(" & ".join(ours) + r" \\")
        if any(theirs[1:]):
            lines.append(" & ".join(theirs) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def _pair(numbers: Sequence[float]) -> list[str]:
    mean, std, median, iqr = map(_number, numbers)
    return [rf"{mean}\scriptsize{{$\pm${std}}}", rf"{median}\scriptsize{{$\pm${iqr}}}"]


def as_csv(entries: Table) -> str:
    """All numbers, a row for each system and way; the paper's where there are any."""
    file = io.StringIO()
    fields = list(Entry.__dataclass_fields__)
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["system", "way", *fields, *(f"paper_{n}" for n in ("mean", "std", "median", "iqr"))])
    for system in _systems(entries):
        for way in WAYS:
            entry = entries.get((system, way.name))
            if entry is not None:
                writer.writerow([system, way.name, *(getattr(entry, n) for n in fields),
                                 *(published(system, way.name) or [""] * 4)])
    return file.getvalue()


def figure(entries: Table) -> Figure:
    """Mean error of each way, logarithmic, a panel for each system: dots ours (bars: the seeds), rings the paper's."""
    import matplotlib
    from matplotlib.figure import Figure

    from nocl.comparisons.report.style import COLOURS, STYLE

    systems = _systems(entries)
    with matplotlib.rc_context(STYLE):
        drawing = Figure(figsize=(3 + 2.1 * len(systems), 3.2), layout="constrained")
        panels = drawing.subplots(1, len(systems), sharey=True, squeeze=False)[0]
        for system, axes in zip(systems, panels, strict=True):
            for place, way in enumerate(WAYS):
                entry, paper = entries.get((system, way.name)), published(system, way.name)
                if paper is not None:
                    axes.plot(paper[0], place, "o", mfc="none", color=COLOURS[1])
                if entry is not None:
                    axes.plot([entry.lowest, entry.highest], [place, place], "-", color=COLOURS[0])
                    axes.plot(entry.mean, place, "o", ms=4, color=COLOURS[0])
            axes.set(xscale="log", title=system, xlabel="mean error")
        panels[0].set_yticks(range(len(WAYS)), [w.title for w in WAYS])
        panels[0].invert_yaxis()
        handles = [axes.plot([], [], "o", ms=4, color=COLOURS[0])[0],
                   axes.plot([], [], "o", mfc="none", color=COLOURS[1])[0]]
        drawing.legend(handles, ["nocl, over the seeds", "the paper"], loc="outside lower center", ncols=2)
        return drawing
