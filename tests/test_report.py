"""A report's files: complete, self-contained, replaced without touching what others wrote, one truth in all."""

import csv
import json
import re
import xml.etree.ElementTree as ET

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.comparisons import compare
from nocl.comparisons.report import figures
from nocl.comparisons.report.files import write_report
from nocl.comparisons.report.page import plotly_js
from nocl.solvers import LQR
from nocl.systems import double_integrator


def nothing(x, t=0.0):
    if (x[:, 0] > 1.1).any():
        raise RuntimeError("<b>far</b> & away")
    return np.zeros((len(x), 1))


@pytest.fixture(scope="module")
def report():
    ocp = double_integrator.ocp()
    return compare(ocp, {"LQR": LQR(ocp), "no <thing>": nothing}, n=5, seed=0, progress=False)


@pytest.fixture(scope="module")
def folder(report, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "deep" / "report"
    assert report.save(folder) == folder / "report.html"
    return folder


FIGURES = ("gaps", "costs", "map", "timings", "trajectories", "worst", "value")
TABLES = ("summary", "errors", "worst", "timings", "failures")


def test_the_files(folder):
    expected = {"report.html", "rows.csv", "summary.json", "summary.md", "animation.gif",
                *(f"figures/{name}.{form}" for name in FIGURES for form in ("svg", "png")),
                *(f"tables/{name}.{form}" for name in TABLES for form in ("csv", "tex"))}
    assert {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()} == expected
    for name in FIGURES:
        ET.parse(folder / "figures" / f"{name}.svg")
        assert (folder / "figures" / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_the_page_asks_for_nothing_outside_itself(folder):
    """Of the page without plotly's code, which asks for nothing unless maps are drawn: the browser test watches it."""
    whole = (folder / "report.html").read_text()
    page = whole.replace(plotly_js(), "")
    assert len(page) < len(whole) - 4_000_000
    links = re.findall(r"""(?:src|href|url|action)\s*[=(]\s*["']?([^"'\s)>]+)""", page)
    assert links
    assert all(link.startswith(("data:", "#")) for link in links)
    assert not re.search(r"@import|<script src|<iframe|<link rel=.?stylesheet", page)
    assert "default-src 'none'" in page
    assert len(re.findall("<img", page)) == len(FIGURES)


def test_the_page_says_what_was_found(report, folder):
    page = (folder / "report.html").read_text()
    assert "LQR on all 5" in page
    assert "no &lt;thing&gt;" in page
    assert "&lt;b&gt;far&lt;/b&gt; &amp; away" in page
    assert "<b>far" not in page
    for word in ("casadi", "numpy", "double_integrator", "horizon 2", "drawn with seed 0", "prefers-color-scheme"):
        assert word in page


def test_names_are_drawn_as_they_are(tmp_path):
    """A pair of $ starts a formula in matplotlib, and one that is none breaks the drawing."""
    p, v, u = (ca.SX.sym(name) for name in ("p$_{$", "v$^$", "u"))
    odd = nocl.System("odd", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, u), lbu=[-3], ubu=[3], lbx=[-2, -2],
                      ubx=[2, 2], units={"u": r"\$^2$"})
    ocp = nocl.OCP.quadratic(odd, horizon=1.0, x_goal=[0, 0], u_goal=[0],
                             initial_states=nocl.Gaussian(mean=[1, 0], std=[0.1, 0.1]))
    report = compare(ocp, {"$_{$": LQR(ocp), "$^$": nothing}, n=1, progress=False)
    report.save(tmp_path)
    figure = figures.draw(report)["trajectories"]
    figure.draw_without_rendering()
    assert figure.axes[0].get_ylabel() == r"p\$_{\$"
    assert [text.get_text() for text in figure.legends[0].texts] == [r"\$_{\$", r"\$^\$"]


def test_rows_come_back_from_csv_bit_by_bit(report, folder):
    with open(folder / "rows.csv", newline="") as file:
        table = list(csv.DictReader(file))
    rows = report.rows()
    assert len(table) == len(rows) == 10
    for line, row in zip(table, rows, strict=True):
        for key, value in row.items():
            if isinstance(value, list):
                prefix = {"x0": "x0", "x_end": "end", "error": "error"}[key]
                np.testing.assert_array_equal([float(line[f"{prefix}_{name}"]) for name in "pv"], value)
            elif isinstance(value, (bool, str)):
                assert line[key] == str(value)
            else:
                np.testing.assert_array_equal(float(line[key]), value)


def test_the_summary_comes_back_from_json(report, folder):
    data = json.loads((folder / "summary.json").read_text())
    assert data["verdict"] == report.verdict()
    assert [row["method"] for row in data["summary"]] == ["LQR", "no <thing>"]
    assert data["summary"][0]["cost_mean"] == report.summary()[0]["cost_mean"]
    assert data["settings"]["seed"] == 0
    assert {"nocl", "casadi", "numpy"} <= set(data["versions"])


@pytest.mark.slow
def test_a_report_is_replaced_and_foreign_files_stay(report, tmp_path):
    report.save(tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "figures" / "photo.png").write_bytes(b"mine")
    ocp = report.ocp
    other = compare(ocp, {"alone": LQR(ocp)}, n=2, progress=False)
    other.save(tmp_path)
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert (tmp_path / "figures" / "photo.png").read_bytes() == b"mine"
    page = (tmp_path / "report.html").read_text()
    assert "Only alone has answers that count, on all 2 initial states: there is nothing to compare" in page
    assert not (tmp_path / "figures" / "costs.svg").exists()  # there is nothing to set side by side any more
    assert not list(tmp_path.rglob("*.part"))


def test_all_methods_may_fail(tmp_path):
    ocp = double_integrator.ocp()

    def broken(x, t=0.0):
        raise KeyError("weights")

    report = compare(ocp, {"broken": broken}, n=1, progress=False)
    page = report.save(tmp_path).read_text()
    assert "KeyError" in page
    assert "broken on 0 of 1" in page


def test_a_file_in_the_way_is_told_and_kept(report, tmp_path):
    path = tmp_path / "report"
    path.write_text("mine")
    for folder in (path, path / "deeper"):
        with pytest.raises(ValueError, match="is a file; expected a folder"):
            write_report(report, folder)
    assert path.read_text() == "mine"
    assert list(tmp_path.iterdir()) == [path]
