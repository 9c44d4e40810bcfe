"""The page of a report: what its data mean, and what a real browser makes of it, for a user's own problem."""

import base64
import io
import json
import math
import re
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import nocl
from nocl.comparisons import compare
from nocl.comparisons.report import payload as packing
from nocl.comparisons.report.animate import animate, so_far
from nocl.comparisons.report.drawings import drawing, phase
from nocl.comparisons.report.explain import worst
from nocl.comparisons.report.findings import (
    MethodAudit,
    Promise,
    Region,
    Robustness,
    Rollouts,
    Scenario,
    ScenarioLoss,
    Stability,
    ValueAudit,
)
from nocl.comparisons.report.page import script_json
from nocl.comparisons.report.report import Report
from nocl.comparisons.report.results import (
    Judged,
)
from nocl.comparisons.report.tables import Table, tables
from nocl.judge import Simulation
from nocl.solvers import LQR
from nocl.systems import double_integrator

MINE = '''
import casadi as ca
import nocl

px, py, vx, vy, ax, ay = (ca.SX.sym(name) for name in ("px", "py", "vx", "vy", "ax", "ay"))
sled = nocl.System("sled", x=ca.vertcat(px, py, vx, vy), u=ca.vertcat(ax, ay), xdot=ca.vertcat(vx, vy, ax, ay),
                   lbu=[-2, -2], ubu=[2, 2], lbx=[-3] * 4, ubx=[3] * 4, units={"px": "m", "py": "m"})
ocp = nocl.OCP.quadratic(sled, horizon=2.0, x_goal=[0] * 4, u_goal=[0, 0],
                         initial_states=nocl.Gaussian(mean=[1.5, 0.5, 0, 0], std=[0.2, 0.4, 0, 0]),
                         path_constraints={"rock": (px - 0.7)**2 + py**2 - 0.04})
'''


def weak(x, t=0.0):
    """A law that saturates, and fails far up."""
    if (x[:, 1] > 1.0).any() and t == 0:
        raise RuntimeError("too <far> up")
    return np.clip(-1.5 * x[:, :2] - 1.2 * x[:, 2:], -1, 1)


@pytest.fixture(scope="module")
def mine(tmp_path_factory):
    """A user's problem, from a file of its own."""
    path = tmp_path_factory.mktemp("user") / "sled.py"
    path.write_text(MINE)
    ocp = nocl.load_ocp(path)
    return compare(ocp, {"LQR": LQR(ocp), "weak & mine": weak}, n=10, seed=3, progress=False)


@pytest.fixture(scope="module")
def studied(mine):
    """The same with all that a study finds, made up."""
    B, K, nx, rng = len(mine.x0), 5, 4, np.random.default_rng(0)
    t = np.linspace(0, 2, K)
    value = ValueAudit(*rng.uniform(0, 1, (2, B)), "NMPC", *rng.uniform(0, 1, (4, B)), t, *rng.uniform(0, 1, (2, B, K)))
    rollout = Rollouts("exact f, RK4", t, np.zeros((B, K, nx)), np.zeros((B, K - 1, 2)), np.ones(B))
    audit = MethodAudit("LQR", (rollout,), np.full(B, np.nan), rng.normal(size=B), value)
    yes = np.arange(B) > 0
    losses = tuple(ScenarioLoss(name, "continuous feedback", rng.uniform(1, 2, B), np.ones(B), yes, np.full(B, 0.1))
                   for name in ("LQR", "weak & mine"))
    robust = Robustness(mine.x0, (Scenario("kicks", "A kick at a random time.", losses),
                                  Scenario("mass + 20 %", "A heavier <sled>.", losses)), {})
    promise = Promise("LQR", 5.0, 0.99, 10, 9, 0.5)
    poles = Stability("LQR", "goal", 1.9, np.array([[-1 + 1j, -1 - 1j, -2, -3]]), np.zeros((1, 2, 4)), np.ones(1))
    region = Region("LQR", 5.0, 0.95, np.array([1.0, 2.0]), np.array([9, 4]), 10, np.array([0.6, 0.2]),
                    np.array([1.0, 0.7]), np.stack([mine.x0, 2 * mine.x0]), rng.uniform(size=(2, 10)) < 0.5)
    return replace(mine, audits=(audit,), robustness=robust, promises=(promise,), stability=(poles,), regions=(region,))


@pytest.fixture(scope="module")
def saved(studied, tmp_path_factory):
    return studied.save(tmp_path_factory.mktemp("page"), animation=False)


def unpack(text, kind="<f4"):
    return np.frombuffer(base64.b64decode(text), dtype=kind)


def test_runs_come_back_to_a_step_of_their_range():
    """|error| <= range / (2 * 65534), in float32; what is missing stays missing."""
    run = np.random.default_rng(0).normal(size=(3, 41, 2)) * [1e-3, 1e4]
    run[1, 20:, 0] = np.nan
    run[2, :, 1] = 7.0
    data = packing.quantised(run)
    steps = unpack(data["runs"], "<u2").reshape(run.shape).astype(float)
    low, high = unpack(data["limits"]).reshape(3, 1, 2, 2).transpose(3, 0, 1, 2)
    back = np.where(steps == packing.MISSING, np.nan, low + (high - low) * steps / (packing.MISSING - 1))
    np.testing.assert_array_equal(np.isnan(back), np.isnan(run))
    allowed = np.broadcast_to((high - low) / (2 * (packing.MISSING - 1)) + 3e-7 * np.maximum(abs(low), abs(high)),
                              run.shape)
    known = ~np.isnan(run)
    assert (np.abs(back - run)[known] <= allowed[known]).all()


def test_the_cost_to_go_starts_at_the_judged_cost_and_is_the_value_of_lqr():
    """Along LQR's run of a linear-quadratic problem what is still to pay is x' S(t) x, at every node."""
    ocp = double_integrator.ocp()
    lqr = LQR(ocp)
    report = compare(ocp, {"LQR": lqr}, n=3, progress=False)
    j = report.judged[0]
    left = packing.cost_to_go(report, j)
    np.testing.assert_allclose(left[:, 0], j.simulation.cost, rtol=1e-12)
    np.testing.assert_allclose(left[:, -1], j.simulation.terminal_cost, rtol=1e-12)
    V = packing.values_along(j, j.simulation.t, j.simulation.x, report.parameters)
    np.testing.assert_allclose(left, V, atol=2e-3 * V.max())


def test_slices_are_the_value_function(mine):
    data = packing.slices(mine)
    n, (i, k) = data["n"], data["pairs"][0]
    V = unpack(data["V"]).reshape(len(data["pairs"]), len(data["t"]), n, n)
    x = np.array(data["base"][1])
    x[i] = np.linspace(data["low"][i], data["high"][i], n)[7]
    x[k] = np.linspace(data["low"][k], data["high"][k], n)[30]
    assert data["method"] == "LQR"
    np.testing.assert_allclose(V[0, 1, 30, 7], LQR(mine.ocp).value(x, data["t"][1]), rtol=1e-5)


def test_a_phase_portrait_is_of_what_moves():
    for name, pair in {"dubins": [0, 1], "pendulum": [0, 1], "quadrotor": [2, 8]}.items():
        ocp = nocl.load_ocp(name)
        report = compare(ocp, {"idle": lambda x, t, nu=ocp.system.nu: np.zeros((len(x), nu))}, n=2, progress=False)
        assert packing.plane(report) == pair, name


def test_the_edge_of_an_obstacle(mine):
    (edge,) = packing.obstacles(mine)
    n = edge["n"]
    a, b = np.meshgrid(np.linspace(*edge["x"], n), np.linspace(*edge["y"], n))
    assert (edge["i"], edge["k"]) == (0, 1)
    np.testing.assert_allclose(unpack(edge["h"]).reshape(n, n), (a - 0.7)**2 + b**2 - 0.04, atol=1e-5)


def test_many_runs_are_thinned_to_what_fits_and_keep_the_worst(mine):
    def many(B):
        s = mine.judged[0].simulation
        gap = np.linspace(0, 100, B)
        fields = {name: np.resize(getattr(s, name), (B, *getattr(s, name).shape[1:])) for name in
                  ("x", "u", "cost", "running_cost", "terminal_cost", "terminal_error", "control_magnitude",
                   "saturation", "clearance", "violation", "success")}
        fields |= {"cost": 1 + gap / 100, "clearance": np.ones(B), "violation": np.zeros(B),
                   "success": np.ones(B, dtype=bool)}
        fine = Judged("fine", "continuous feedback", replace(s, message=[""] * B, **fields), *np.ones((5, B)))
        best = replace(fine, name="best", simulation=replace(fine.simulation, cost=np.ones(B)))
        return Report(mine.ocp, np.resize(mine.x0, (B, 4)), (fine, best), {}, 1.0)

    assert packing.kept_states(many(1000))[0] >= 41  # the size that the page is made for: a curve is smooth on 41 nodes
    nodes, states = packing.kept_states(many(40_000))
    assert nodes == min(packing.NODES)
    assert len(states) < 40_000
    assert 39_999 in states  # the worst
    assert len(packing.payload(many(1000))["methods"][0]["runs"]) < packing.NODES[41] / 2


def three_ways(B=12):
    """A method that goes the best one's way from all states but one, where it ends in another place."""
    ocp = double_integrator.ocp()
    t = np.linspace(0, 2, 21)
    x0 = np.c_[np.linspace(0, 1, B), np.zeros(B)]
    x = np.stack([x0[:, :1] * (1 - t / 2), -x0[:, :1] / 2 + 0 * t], axis=2)

    def judged(name, x, running, terminal):
        zero, one = np.zeros(B), np.ones(B)
        s = Simulation(t, x, np.zeros((B, 21, 1)), running + terminal, running, terminal, one, one, zero,
                       np.full(B, math.inf), zero, np.ones(B, dtype=bool), [""] * B, np.ones(B, dtype=bool),
                       np.full(B, -1), *np.full((2, B), math.nan))
        return Judged(name, "continuous feedback", s, one, one, zero, one, one)

    other = x.copy()
    other[5] += np.sin(np.pi * t / 2)[:, None] * 3
    terminal = np.full(B, 0.2)
    terminal[5] = 0.9
    return Report(ocp, x0, (judged("mine", other, np.ones(B), terminal),
                            judged("theirs", x, np.ones(B), np.full(B, 0.2))), {}, 1.0)


def test_the_worst_state_is_explained():
    (first,) = worst(three_ways())
    said = " ".join(first.sentences)
    assert first.state == 5
    assert first.gap == pytest.approx(100 * 0.7 / 1.2)
    assert "basins" not in said  # the neighbours' best runs go the way of this state's
    for text in ("by theirs: 58.3 % more", "Lost in the terminal cost (running +0, terminal +0.7)",
                 "another way than the best run", "this state is on its own"):
        assert text in said


def test_tables_in_four_forms():
    table = Table("T", ["a_b", "c"], [["x|y & <z>", "50 %"]], text=True)
    assert "x&#x7C;y" not in table.html()
    assert "<td>x|y &amp; &lt;z&gt;</td>" in table.html()
    assert r"x\|y & \<z>" in table.markdown()
    assert r"a\_b & c \\" in table.latex()
    assert r"x|y \& \textless{}z\textgreater{} & 50 \% \\" in table.latex()
    assert table.csv() == "a_b,c\nx|y & <z>,50 %\n"


def test_data_cannot_end_its_script():
    text = script_json({"a": "</script><b>", "b": [math.nan, math.inf, 1.5]})
    assert "<" not in text
    assert json.loads(text) == {"a": "</script><b>", "b": [None, None, 1.5]}


def test_all_of_a_study_is_shown(studied, saved):
    page, folder = saved.read_text(), saved.parent
    assert {"audits", "robustness", "promises", "stability", "regions", "failures"} <= set(tables(studied))
    for text in ("with 99 % confidence, at least 50 % of the initial states", "A heavier &lt;sled&gt;.", "kicks",
                 "too &lt;far&gt; up", "Local stability", "Region of initial states"):
        assert text in page
    order = [page.index(f"<section id={name}>") for name in ("explore", "gaps", "value", "worst", "timings", "audits",
                                                             "robustness", "promises", "stability", "regions", "run")]
    assert order == sorted(order)
    for name in ("robustness", "stability", "regions"):
        assert (folder / "figures" / f"{name}.svg").is_file()
    assert "## Robustness: cost lost" in (folder / "summary.md").read_text()
    assert not (folder / "animation.gif").exists()


def test_controls_move_as_they_were_held():
    t, u = np.array([0.0, 1.0, 2.0]), np.array([[1.0], [3.0], [3.0]])
    np.testing.assert_array_equal(so_far(t, u, 0.5, held=True), [[1.0], [1.0]])
    np.testing.assert_array_equal(so_far(t, u, 1.0, held=True), [[1.0], [3.0], [3.0]])
    np.testing.assert_allclose(so_far(t, u, 0.5), [[1.0], [2.0]])
    np.testing.assert_allclose(so_far(t, u, 2.0)[-1], [3.0])


@pytest.mark.parametrize("name", ["cartpole", "acrobot", "quadrotor", "dubins", "pendulum", "van_der_pol"])
def test_every_bundled_system_moves(name):
    ocp = nocl.load_ocp(name)
    report = compare(ocp, {"idle": lambda x, t: np.repeat([ocp.u_goal + 0.1], len(x), axis=0)}, n=1, progress=False)
    gif = animate(report, seconds=0.4)
    image = Image.open(io.BytesIO(gif))
    assert image.n_frames == 6
    assert (drawing(ocp) is phase) == (name == "van_der_pol")
    first = np.asarray(image.convert("RGB")).astype(int)
    image.seek(5)
    assert np.abs(np.asarray(image.convert("RGB")).astype(int) - first).max() > 50


def test_an_animation_is_short_and_small(mine):
    gif = animate(mine)
    image = Image.open(io.BytesIO(gif))
    lasts = 0
    for k in range(image.n_frames):
        image.seek(k)
        lasts += image.info["duration"]
    assert 3000 <= lasts <= 5000
    assert len(gif) < 2e6


def test_a_user_may_draw(mine):
    seen = []

    def draw(ax, ocp, visited):
        (dot,) = ax.plot([], [], "o")

        def frame(x, u, t):
            seen.append((x.shape, u.shape, t))
            dot.set_data(x[-1:, 0], x[-1:, 1])
            return [dot]

        return frame

    animate(mine, state=0, methods=["LQR"], draw=draw, seconds=0.2)
    assert seen[0] == ((2, 4), (2,), 0.0)
    assert seen[-1][2] == mine.ocp.horizon


def test_what_cannot_be_animated_is_told(mine):
    failed = int(np.flatnonzero(~mine.judged[1].simulation.reached)[0])
    for options, text in (({"state": 99}, "expected one of the 10"), ({"methods": ["?"]}, "there is no method '\\?'"),
                          ({"state": failed}, "a method failed from state")):
        with pytest.raises(ValueError, match=text):
            animate(mine, **options)


# ---- in a browser ----------------------------------------------------------------------------------------------------

FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
         "--disable-component-update", "--disable-sync"]


@pytest.fixture(scope="module")
def browser():
    """Debian's chromium, headless; skipped with the reason where there is none."""
    playwright = pytest.importorskip("playwright.sync_api", reason="no playwright: pip install playwright")
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if found is None:
        pytest.skip("no chromium on this machine: apt-get install chromium")
    with playwright.sync_playwright() as p, tempfile.TemporaryDirectory() as home:
        browser = p.chromium.launch(executable_path=found, args=FLAGS, env={"HOME": home})
        yield browser
        browser.close()


class Watched:
    """A page of the browser with what it complained about and asked for."""

    def __init__(self, browser, path: Path, **look):
        self.context = browser.new_context(**({"viewport": {"width": 1280, "height": 900}} | look))
        self.page = self.context.new_page()
        self.errors, self.requests = [], []
        self.page.on("console", lambda m: self.errors.append(m.text) if m.type in ("error", "warning") else None)
        self.page.on("pageerror", lambda e: self.errors.append(str(e)))
        self.page.on("request", lambda r: self.requests.append(r.url))
        self.page.goto(path.as_uri())
        self.page.wait_for_selector("#map .point")
        self.page.evaluate("document.getElementById('panel').scrollIntoView({behavior: 'instant'})")
        self.page.wait_for_selector("#runs .scatterlayer path.js-line")  # figures are drawn as they come into view

    def through(self):
        """Scroll through all of the page, so that every figure is drawn; the ids of those that are."""
        ids = [e.get_attribute("id") for e in self.page.query_selector_all(".plot")]
        for name in ids:
            self.page.evaluate(f"document.getElementById('{name}').scrollIntoView({{behavior: 'instant'}})")
            self.page.wait_for_selector(f"#{name} .main-svg")
        return ids

    def until(self, condition):
        """Wait for what the page's own policy forbids playwright to wait for inside it."""
        for _ in range(200):
            if self.page.evaluate(condition):
                return
            self.page.wait_for_timeout(50)
        raise AssertionError(f"never {condition}")

    def curves(self):
        return [e.get_attribute("d") for e in self.page.query_selector_all("#runs .scatterlayer path.js-line")]

    def outside(self):
        return [url for url in self.requests if not url.startswith(("data:", "blob:"))][1:]  # the first is the page


def test_the_page_in_a_browser(browser, saved):
    """It renders; a click changes the runs, and so do the worst states' buttons; no error, no outside request."""
    w = Watched(browser, saved)
    assert {"map", "runs", "along", "phase", "ecdf", "costs", "slice", "times", "robust", "poles", "region",
            "regionmap"} == set(w.through())
    before, state = w.curves(), w.page.get_attribute("#panel", "data-state")
    points = w.page.locator("#map .trace").first.locator("path.point")
    assert points.count() + w.page.locator("#map .trace").nth(1).locator("path.point").count() >= 10
    w.page.evaluate("document.getElementById('map').scrollIntoView({behavior: 'instant', block: 'center'})")
    for k in range(points.count()):  # a click on a point, as a user's
        box = points.nth(k).bounding_box()
        w.page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        if w.page.get_attribute("#panel", "data-state") != state:
            break
    chosen = w.page.get_attribute("#panel", "data-state")
    assert chosen != state
    assert w.curves() != before
    assert f"State {chosen}:" in w.page.inner_text("#which")
    assert "audit of LQR" in w.page.inner_text("#audit")
    assert "|V - J|" in w.page.inner_text("#audit")
    before = w.curves()
    w.page.check("#models")
    assert len(w.curves()) == len(before) + 4  # one rollout's four states
    w.page.uncheck("#models")
    clicked = w.curves()
    w.page.click("#next")
    assert w.curves() != clicked
    assert w.errors == []
    assert w.outside() == []
    w.context.close()


def test_the_runs_that_are_drawn_are_the_judged_ones(browser, mine, saved):
    w = Watched(browser, saved)
    w.page.fill("#number", "2")
    w.page.press("#number", "Enter")
    data = w.page.evaluate("document.getElementById('runs').data.map((t) => [t.name, [...t.y], [...t.x]])")
    s = mine.judged[0].simulation
    assert data[0][0] == "LQR"
    np.testing.assert_allclose(data[0][1], np.interp(data[0][2], s.t, s.x[2, :, 0]), atol=1e-4)
    w.context.close()


def test_selects_and_colours(browser, saved):
    """Any two coordinates, or the gap itself; dark figures on a dark page."""
    w = Watched(browser, saved, color_scheme="dark")
    assert w.page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(20, 23, 26)"
    assert w.page.evaluate("document.getElementById('map').layout.font.color") == "#e3e7eb"
    w.page.select_option("#across", "1")
    w.page.select_option("#up", "gap")
    assert "py [m]" in w.page.text_content("#map .xtitle")
    assert w.page.evaluate("document.getElementById('map').layout.yaxis.type") == "log"
    w.through()
    w.page.emulate_media(color_scheme="light")
    w.until("document.getElementById('ecdf').layout.font.color === '#1b1f24'")
    assert w.errors == []
    w.context.close()


def test_the_page_on_a_phone(browser, saved):
    """Nothing but the insides of boxes is wider than the screen; a tap chooses a state."""
    w = Watched(browser, saved, viewport={"width": 390, "height": 844}, is_mobile=True, has_touch=True)
    w.through()
    assert w.page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    box = w.page.locator(".scroll").first  # the wide summary scrolls within itself
    assert box.evaluate("(e) => e.scrollWidth > e.clientWidth")
    before = w.curves()
    w.page.tap("#next")
    assert w.curves() != before
    assert w.errors == []
    w.context.close()


def test_the_page_on_paper_and_without_javascript(browser, saved):
    """On paper the still pictures stand where the plots do on the screen; so they do without JavaScript."""
    w = Watched(browser, saved)
    assert not w.page.is_visible("img.static >> nth=0")
    w.page.emulate_media(media="print")
    assert w.page.is_visible("img.static >> nth=0")
    assert not w.page.is_visible("#map")
    w.context.close()
    context = browser.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(saved.as_uri())
    assert page.is_visible("img.static >> nth=0")
    assert not page.is_visible("#map")
    assert re.search("Within 5 %", page.inner_text("body"))
    context.close()
