"""Table I made again: cells are kept and taken up, other budgets make them anew, and every form says the same."""

import csv
import dataclasses
import io

import pytest

from nocl.cli import commands
from nocl.comparisons.reproduce import sysid
from nocl.comparisons.reproduce.sysid import TABLE

TINY = sysid.Plan(iterations=3, seeds=2, problems=("dubins",), ways=("relu-values", "sine-gradients", "nocl"),
                  quick=True)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return folder, TABLE.run(folder, TINY, progress=False)


def test_the_papers_numbers_stand_beside_ours():
    assert [w.method for w in list(sysid.WAYS.values())[:6]] == ["paper"] * 6
    assert all(len(rows) == 6 for rows in sysid.PAPER.values())
    assert sysid.published("quadrotor", "sine-values") == (1.3109, 0.9937, 1.0362, 0.9085)
    assert sysid.published("acrobot", "sine-gradients")[0] == 0.0664
    assert sysid.published("dubins", "nocl") is None
    assert min(sysid.published("dubins", w.name)[0] for w in list(sysid.WAYS.values())[:6]) == 0.0008


def test_finished_cells_are_taken_up(made):
    folder, first = made
    before = {p: p.stat().st_mtime_ns for p in (folder / "cells").iterdir()}
    assert len(before) == 6
    assert TABLE.run(folder, TINY, progress=False) == first
    assert {p: p.stat().st_mtime_ns for p in (folder / "cells").iterdir()} == before
    assert sorted(TABLE.finished(folder), key=str) == sorted(first, key=str)


def test_other_budgets_make_a_cell_anew(made, tmp_path):
    plan = sysid.Plan(iterations=4, seeds=1, problems=("dubins",), ways=("relu-values",), quick=True)
    (first,) = TABLE.run(tmp_path, plan, progress=False)
    (again,) = TABLE.run(tmp_path, dataclasses.replace(plan, iterations=5), progress=False)
    assert (first.settings["iterations"], again.settings["iterations"]) == (4, 5)
    (tmp_path / "cells" / "dubins-relu-values-0.json").write_text("{}")
    with pytest.raises(ValueError, match="no cell of Table I"):
        TABLE.run(tmp_path, plan, progress=False)


def test_entries_are_means_over_seeds(made):
    _, cells = made
    own = [c for c in cells if c.way == "relu-values"]
    entry, _, nocl = TABLE.entries(cells)
    assert [e.way for e in TABLE.entries(cells)] == ["relu-values", "sine-gradients", "nocl"]
    assert entry.mean == pytest.approx((own[0].score.mean + own[1].score.mean) / 2)
    assert (entry.lowest, entry.highest) == tuple(sorted(c.score.mean for c in own))
    assert entry.seeds == 2
    assert nocl.mean < 1e-12


def test_cells_of_smaller_budgets_are_not_averaged_with_the_others(made):
    _, cells = made
    cell = next(c for c in cells if c.way == "relu-values")
    score = dataclasses.replace(cell.score, mean=10 * cell.score.mean)
    short = dataclasses.replace(cell, seed=7, score=score, settings={**cell.settings, "iterations": 1})
    assert TABLE.entries([*cells, short]) == TABLE.entries(cells)


def test_all_forms_hold_every_cell(made, tmp_path):
    _, cells = made
    paths = TABLE.write(tmp_path, cells)
    assert [p.suffix for p in paths] == [".md", ".tex", ".csv", ".png"]
    lines = (tmp_path / "sysid.md").read_text().splitlines()
    assert len(lines) == 2 + 3
    assert all(line.count("|") == lines[0].count("|") for line in lines)
    rows = list(csv.DictReader(io.StringIO((tmp_path / "sysid.csv").read_text())))
    assert [r["way"] for r in rows] == list(TINY.ways)
    assert float(rows[1]["paper_mean"]) == 0.0008
    tex = (tmp_path / "sysid.tex").read_text()
    assert "0.0008" in tex
    assert tex.count(r"\begin{tabular}") == tex.count(r"\end{tabular}") == 1


def test_what_is_not_in_the_table_is_refused():
    for bad in ({"problems": ("pendulum",)}, {"ways": ("gelu",)}, {"seeds": 0}, {"iterations": True}):
        with pytest.raises(ValueError, match="reproduce sysid"):
            TABLE.places(sysid.Plan(**bad))


def test_the_command(made, capsys):
    folder, _ = made
    words = ["reproduce", "sysid", "--quick", "--iterations", "3", "--seeds", "2", "--systems", "dubins", "--ways",
             ",".join(TINY.ways), "--out", str(folder)]
    assert commands.main(words) == 0
    assert "| dubins | ReLU (without gradients) | 3 x 256, 128 wide; " in capsys.readouterr().out
    assert commands.main(["reproduce", "sysid", "--systems", "mars", "--out", str(folder)]) == 2
    assert commands.main(["reproduce"]) == 2
