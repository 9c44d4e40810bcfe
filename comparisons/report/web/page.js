"use strict";
(() => {
const D = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const nx = D.states.length, nu = D.controls.length, M = D.methods.length, B = D.B;
const NAMES = D.states.concat(D.controls);
const MISSING = 65535, FLOOR = 1e-3, LOSS_FLOOR = 1e-2;  // per cent
const dark = window.matchMedia("(prefers-color-scheme: dark)");
const coarse = window.matchMedia("(pointer: coarse)");
const LIGHT = ["#0072b2", "#d55e00", "#00815f", "#b0508f", "#8a6d00", "#3794c9", "#1b1f24"];
const DARK = ["#5cb3ff", "#ff8f4f", "#36d1a2", "#f0a3cf", "#f3cf4d", "#a5dcff", "#e3e7eb"];
const DASH = ["solid", "dash", "dashdot", "dot"];
const HEAT = [[0, "#3b82c4"], [0.35, "#6fb07f"], [0.65, "#f2b134"], [1, "#d7301f"]];
const colour = (m) => (dark.matches ? DARK : LIGHT)[m % LIGHT.length];
const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

// ---- arrays -------------------------------------------------------------------------------------------------------
function bytes(text) {
  const raw = atob(text), out = new Uint8Array(raw.length);
  for (let k = 0; k < raw.length; k++) out[k] = raw.charCodeAt(k);
  return out;
}
const floats = (text) => new Float32Array(bytes(text).buffer);
const X0 = floats(D.x0), GAP = floats(D.gap);
const PARAMETERS = D.parameters || [], np = PARAMETERS.length, P = np ? floats(D.p) : null, GOALS = D.goals ? floats(D.goals) : null;
const x0 = (i, k) => k < nx ? X0[i * nx + k] : P[i * np + k - nx - nu];  // parameters count on after the controls
const goal = (k) => GOALS ? GOALS[state * (nx + nu) + k] : D.goal[k];  // of the state that is shown
const gap = (m, i) => GAP[m * B + i];
const NUMBERS = D.methods.map((method) => floats(method.numbers));
const column = (name) => D.numbers.indexOf(name);
const number = (m, i, name) => NUMBERS[m][i * D.numbers.length + column(name)];
const place = new Map((D.kept || Array.from({length: B}, (_, i) => i)).map((i, row) => [i, row]));
const opened = new Map();
const times = (m, r) => D.methods[m].t || r[D.channels.time];  // of a run: its own where the horizon is free
const run = (m, i) => place.has(i) ? unpacked(D.methods[m], place.get(i), place.size) : null;
function unpacked(entry, row, rows) {  // [channel][node] of one of the packed runs
  if (!opened.has(entry)) opened.set(entry, {steps: new Uint16Array(bytes(entry.runs).buffer), limits: floats(entry.limits)});
  const {steps, limits} = opened.get(entry), C = limits.length / 2 / rows, K = steps.length / C / rows;
  return Array.from({length: C}, (_, c) => {
    const low = limits[(row * C + c) * 2], width = limits[(row * C + c) * 2 + 1] - low;
    return Array.from({length: K}, (_, k) => {
      const step = steps[(row * K + k) * C + c];
      return step === MISSING ? null : low + width * step / (MISSING - 1);
    });
  });
}

// ---- text ---------------------------------------------------------------------------------------------------------
function text(value) {
  if (value === null || Number.isNaN(value)) return "-";
  if (!Number.isFinite(value)) return value > 0 ? "∞" : "-∞";
  const size = Math.abs(value);
  return value === 0 ? "0" : size < 1e-3 || size >= 1e5 ? value.toExponential(2) : String(Number(value.toPrecision(4)));
}
const percent = (value) => Number.isFinite(value) ? text(Number(Math.max(value, 0).toPrecision(3))) + " %" : "failed";
const safe = (value) => String(value).replace(/[&<>"]/g, (c) => ({"&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;"})[c]);
const MNAMES = D.methods.map((method) => safe(method.name));  // plotly reads names as a little HTML
const LABELS = D.labels.concat(D.plabels || []).map(safe);

// ---- plots --------------------------------------------------------------------------------------------------------
function axis(extra) {
  return Object.assign({gridcolor: css("--line"), zerolinecolor: css("--line"), linecolor: css("--line"),
                        automargin: true, zeroline: false}, extra);
}
function layout(extra) {
  const small = window.innerWidth < 700;
  return Object.assign({
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", hovermode: "closest",
    font: {family: "system-ui, -apple-system, 'Segoe UI', 'DejaVu Sans', sans-serif", size: small ? 11 : 12, color: css("--text")},
    margin: {l: 50, r: 14, t: 34, b: 44}, dragmode: coarse.matches ? false : "zoom", showlegend: true,
    hoverlabel: {bgcolor: css("--soft"), bordercolor: css("--line"), font: {color: css("--text")}},
    legend: {orientation: "h", x: 0, y: 1.02, yanchor: "bottom", bgcolor: "rgba(0,0,0,0)"},
    modebar: {bgcolor: "rgba(0,0,0,0)", color: css("--quiet"), activecolor: css("--text")},
  }, extra);
}
const CONFIG = {responsive: true, displaylogo: false, displayModeBar: coarse.matches ? false : "hover",
                modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"], showLink: false};
const draw = (id, traces, extra) => Plotly.react($(id), traces, layout(extra), CONFIG);
const log = (title, extra) => axis(Object.assign({type: "log", title: {text: title}, exponentformat: "none"}, extra));
const line = (m, more) => Object.assign({color: colour(m), dash: DASH[m % DASH.length], width: 2}, more);

// ---- gap against initial state, and one state's runs ----------------------------------------------------------------
let state = 0;
const ok = (m, i) => D.feasible[m][i] === 1 && Number.isFinite(gap(m, i));
function hover(i) {
  return `state ${i}<br>` + MNAMES.map((name, m) => `${name}: ${ok(m, i) ? "+" + percent(gap(m, i)) : "failed"}`).join("<br>");
}
function upward(m) {  // heights of the states of one trace
  const up = $("up").value;
  return up === "gap" ? (i) => Math.max(gap(m, i), FLOOR) : (i) => x0(i, Number(up));
}
function points(m, shown, marker, name) {
  const y = upward(m), across = Number($("across").value);
  return {type: "scatter", mode: "markers", name, x: shown.map((i) => x0(i, across)), y: shown.map(y), customdata: shown,
          hovertext: shown.map(hover), hoverinfo: "text", marker};
}
function drawMap() {
  const all = Array.from({length: B}, (_, i) => i), up = $("up").value, C = Number($("colour").value);
  const traces = [];
  $("colour").disabled = up === "gap";
  if (up === "gap") {
    D.methods.forEach((_, m) => traces.push(points(m, all.filter((i) => ok(m, i)),
      {color: colour(m), size: 7, symbol: ["circle", "square", "diamond", "triangle-up"][m % 4], opacity: 0.75}, MNAMES[m])));
  } else {
    const good = all.filter((i) => ok(C, i)), bad = all.filter((i) => !ok(C, i));
    const shade = good.map((i) => Math.log10(Math.max(gap(C, i), FLOOR)));
    traces.push(points(C, good, {color: shade, cmin: -2, cmax: 2, colorscale: HEAT, size: 8,
      line: {width: 0.5, color: css("--back")}, colorbar: {title: {text: "gap", side: "top"}, thickness: 10, len: 0.9, outlinewidth: 0,
      tickvals: [-2, -1, 0, 1, 2], ticktext: ["≤ 0.01 %", "0.1 %", "1 %", "10 %", "≥ 100 %"]}}, MNAMES[C]));
    if (bad.length) traces.push(points(C, bad, {symbol: "x", size: 8, color: css("--text")}, "failed or violates"));
  }
  traces.push(Object.assign(points(up === "gap" ? D.explained : C, [state], {symbol: "circle-open", size: 16,
    color: css("--text"), line: {width: 2.5}}, "shown below"), {hoverinfo: "skip"}));
  draw("map", traces, {xaxis: axis({title: {text: LABELS[Number($("across").value)]}}),
    yaxis: up === "gap" ? log("gap [%]") : axis({title: {text: LABELS[Number(up)]}}), showlegend: up === "gap" || traces.length > 2});
}
function outcome(m) {
  const method = D.methods[m], failed = method.failed[state], cells = ["cost", "running", "terminal"].map((name) => text(number(m, state, name))).concat(text(100 * number(m, state, "error")));
  const clearance = number(m, state, "clearance");
  return [`<span class=swatch style="border-color:${colour(m)}"></span>${MNAMES[m]}`,
          failed !== undefined ? safe(failed) : "+" + percent(gap(m, state)),
          ...cells, `${(100 * number(m, state, "saturation")).toFixed(0)} %`, ...(Number.isFinite(clearance) || hasPath ? [text(clearance)] : []),
          text(number(m, state, "first")), text(number(m, state, "later"))];
}
const AUDITS = D.audits.map((audit) => ({...audit, values: floats(audit.values)}));
const hasPath = NUMBERS.some((values) => values.some((v, k) => k % D.numbers.length === column("clearance") && Number.isFinite(v)));
function drawOutcome() {
  const head = ["method", "gap", "cost", "running", "terminal", "error at T, %", "at a bound", ...(hasPath ? ["clearance"] : []),
                "ms, first", "ms, later"];
  const rows = D.methods.map((_, m) => "<tr>" + outcome(m).map((cell) => `<td>${cell}</td>`).join("") + "</tr>");
  $("outcome").innerHTML = `<table><thead><tr>${head.map((h) => `<th>${h}</th>`).join("")}</tr></thead><tbody>${rows.join("")}</tbody></table>`;
  $("audit").innerHTML = AUDITS.map((audit) => {
    const n = audit.keys.length, values = Array.from(audit.values.slice(state * n, (state + 1) * n));
    return `<table><thead><tr><th>audit of ${safe(audit.method)}</th>${audit.keys.map((key) => `<th>${safe(key)}</th>`).join("")}</tr></thead>` +
           `<tbody><tr><td></td>${values.map((v) => `<td>${text(v)}</td>`).join("")}</tr></tbody></table>`;
  }).join("");
  const start = [...D.states.map((name, k) => [name, k]), ...PARAMETERS.map((name, k) => [name, nx + nu + k])]
    .map(([name, k]) => `${name} ${text(x0(state, k))}`).join(", ");
  const why = D.impossible[state];
  $("which").textContent = `State ${state}: ${start}` + (why ? `. Left out: ${why}` : D.best[state] >= 0 ? `. Best known by ${D.methods[D.best[state]].name}` : "");
  $("number").value = state;
}
function drawRuns() {
  const n = nx + nu + D.held.length, width = $("runs").clientWidth || 900;
  const columns = Math.min(n, width < 520 ? 1 : width < 900 || n < 6 ? 2 : n < 10 ? 3 : 4), rows = Math.ceil(n / columns);
  const traces = [], extra = {annotations: [], shapes: [], height: 72 + rows * 172, margin: {l: 36, r: 8, t: 48, b: 24}};
  const kept = D.methods.map((_, m) => run(m, state));
  for (let k = 0; k < n; k++) {
    const id = k ? String(k + 1) : "", column = k % columns, row = Math.floor(k / columns);
    const gapx = 0.055, w = (1 - gapx * (columns - 1)) / columns, left = column * (w + gapx), h = 1 / rows;
    const top = 1 - row * h - 20 / (extra.height - 72), bottom = 1 - (row + 1) * h + 24 / (extra.height - 72);
    extra["xaxis" + id] = axis({domain: [left, left + w], anchor: "y" + id, range: [0, D.horizon], automargin: false, nticks: 6});
    extra["yaxis" + id] = axis({domain: [bottom, top], anchor: "x" + id, automargin: false, nticks: 5});
    const held = D.held[k - nx - nu], c = held ? D.channels["held " + held.name] : k;  // of more than one state: its own values
    extra.annotations.push({text: held ? safe(held.name) : LABELS[k], x: left, y: top, xref: "paper", yref: "paper", xanchor: "left", yanchor: "bottom",
                            showarrow: false, font: {size: 12, color: css("--quiet")}});
    const across = (y, dash) => extra.shapes.push({type: "line", xref: "x" + id, yref: "y" + id, x0: 0, x1: D.horizon, y0: y, y1: y,
                                                   layer: "below", line: {color: css("--quiet"), width: 1, dash}});
    if (!held && goal(k) !== null) across(goal(k), "dot");
    const values = kept.flatMap((r) => r ? r[c].filter((v) => v !== null) : []), low = Math.min(...values), high = Math.max(...values);
    const bounds = held ? held.bounds.map((y) => [y, false]) : D.lines.filter((l) => l[0] === k).map((l) => [l[1], l[2]]);
    bounds.filter(([y]) => y >= 2 * low - high && y <= 2 * high - low).forEach(([y, last]) => traces.push({type: "scatter", mode: "lines",
      x: [last ? 0.94 * D.horizon : 0, D.horizon], y: [y, y], xaxis: "x" + id, yaxis: "y" + id, showlegend: false, hoverinfo: "skip",
      line: {color: css("--limit"), width: 1.5, dash: last ? "solid" : "dash"}}));
    if (k >= nx && !held && values.length) {
      const low = D.lbu[k - nx], high = D.ubu[k - nx], room = 0.02 * (high - low);
      if (Math.min(...values) <= low + room) across(low, "dash");
      if (Math.max(...values) >= high - room) across(high, "dash");
    }
    kept.forEach((r, m) => r && traces.push({type: "scatter", mode: "lines", x: times(m, r), y: r[c], xaxis: "x" + id, yaxis: "y" + id,
      name: MNAMES[m], legendgroup: String(m), showlegend: k === 0, hovertemplate: `${MNAMES[m]}: %{y:.4g}<extra>t = %{x:.3g}</extra>`,
      line: line(m, k >= nx && !held && D.methods[m].held ? {shape: "hv"} : {})}));
  }
  if ($("models").checked) AUDITS.forEach((audit) => audit.rollouts.forEach((rollout, c) => {
    const r = unpacked(rollout, state, B), m = D.methods.findIndex((method) => method.name === audit.method);
    for (let k = 0; k < nx; k++) {
      const id = k ? String(k + 1) : "", name = safe(`${audit.method} on the ${rollout.name}`);
      traces.push({type: "scatter", mode: "lines", x: rollout.t, y: r[k], xaxis: "x" + id, yaxis: "y" + id, name, legendgroup: name,
        showlegend: k === 0, hovertemplate: `${name}: %{y:.4g}<extra>t = %{x:.3g}</extra>`, line: {color: colour(m < 0 ? M : m), width: 1.2, dash: DASH[3 - c % 2]}, opacity: 0.75});
    }
  }));
  if (!traces.length) extra.annotations.push({text: "the runs of this state are not kept in this page", x: 0.5, y: 0.5,
                                              xref: "paper", yref: "paper", showarrow: false, font: {size: 16}});
  extra.legend = {orientation: "h", x: 0, xref: "paper", y: 1 + 6 / (extra.height - 72), yanchor: "bottom", bgcolor: "rgba(0,0,0,0)"};
  $("runs").style.height = extra.height + "px";
  draw("runs", traces, extra);
}
function drawAlong() {
  const traces = [], owner = D.slices ? safe(D.slices.method) : "";
  D.methods.forEach((method, m) => {
    const r = run(m, state);
    if (!r) return;
    traces.push({type: "scatter", mode: "lines", name: MNAMES[m], x: times(m, r), y: r[D.channels.togo], line: line(m, {dash: "solid"}),
                 hovertemplate: `${MNAMES[m]} still costs %{y:.4g}<extra>t = %{x:.3g}</extra>`});
    if ("V" in D.channels) traces.push({type: "scatter", mode: "lines", name: `V along ${MNAMES[m]}`, x: times(m, r), y: r[D.channels.V],
      line: line(m, {dash: "dot", width: 2}), hovertemplate: `V of ${owner} along ${MNAMES[m]}: %{y:.4g}<extra>t = %{x:.3g}</extra>`});
  });
  $("alongnote").textContent = "What each run still costs, from t to its end" + (D.slices ? `; dotted: what ${D.slices.method}'s value function V(x(t), t) says along it.` : ".");
  draw("along", traces, {xaxis: axis({title: {text: "t"}}), yaxis: axis({title: {text: "cost to go"}, rangemode: "tozero"})});
}
function obstacleTraces(i, k) {
  return D.obstacles.filter((o) => (o.i === i && o.k === k) || (o.i === k && o.k === i)).map((o) => {
    const h = floats(o.h), n = o.n, swap = o.i !== i;
    const line = (range) => Array.from({length: n}, (_, c) => range[0] + (range[1] - range[0]) * c / (n - 1));
    const z = Array.from({length: n}, (_, r) => Array.from({length: n}, (_, c) => swap ? h[c * n + r] : h[r * n + c]));
    return {type: "contour", x: line(swap ? o.y : o.x), y: line(swap ? o.x : o.y), z, showscale: false, hoverinfo: "skip", name: "forbidden",
            contours: {type: "constraint", operation: ">", value: 0}, fillcolor: dark.matches ? "rgba(255,255,255,0.16)" : "rgba(0,0,0,0.14)",
            line: {color: css("--quiet"), width: 1}, showlegend: false};
  });
}
function drawPhase() {
  const i = Number($("phasex").value), k = Number($("phasey").value);
  const traces = i < nx && k < nx ? obstacleTraces(i, k) : [];
  let first = true;
  D.methods.forEach((method, m) => {
    const r = run(m, state);
    if (!r) return;
    traces.push({type: "scatter", mode: "lines", name: MNAMES[m], x: r[i], y: r[k], line: line(m), text: times(m, r).map(text),
                 hovertemplate: `${MNAMES[m]}, t = %{text}<extra>(%{x:.4g}, %{y:.4g})</extra>`});
    if (first) traces.push({type: "scatter", mode: "markers", name: "start", x: [r[i][0]], y: [r[k][0]], showlegend: false, hoverinfo: "skip",
                            marker: {symbol: "circle-open", size: 11, color: css("--text"), line: {width: 2}}});
    first = false;
  });
  traces.push({type: "scatter", mode: "markers", name: "goal", x: [goal(i)], y: [goal(k)], showlegend: false, hoverinfo: "skip",
               marker: {symbol: "star", size: 12, color: css("--text")}});
  const even = D.obstacles.some((o) => [o.i, o.k].includes(i) && [o.i, o.k].includes(k)) && i !== k ? {scaleanchor: "x", constrain: "domain"} : {};
  draw("phase", traces, {xaxis: axis({title: {text: LABELS[i]}, constrain: "domain"}), yaxis: axis({title: {text: LABELS[k]}, ...even})});
}
function drawState() { drawOutcome(); drawRuns(); drawAlong(); drawPhase(); $("panel").dataset.state = state; }
function choose(i) {
  if (!Number.isInteger(i) || i < 0 || i >= B) { drawOutcome(); return; }
  state = i;
  drawMap();
  drawState();
}

// ---- the other figures ------------------------------------------------------------------------------------------------
function drawEcdf() {
  const traces = D.methods.map((_, m) => {
    const known = Array.from({length: B}, (_, i) => i).filter((i) => ok(m, i)).map((i) => Math.max(gap(m, i), FLOOR)).sort((a, b) => a - b);
    const right = 1e3, x = [FLOOR, ...known, Math.max(right, known.length ? known[known.length - 1] : 0)];
    const y = [0, ...known.map((_, k) => 100 * (k + 1) / D.counted), 100 * known.length / D.counted];
    return {type: "scatter", mode: "lines", name: MNAMES[m], x, y, line: line(m, {shape: "hv"}),
            hovertemplate: `${MNAMES[m]}: %{y:.1f} % of the states within %{x:.3g} %<extra></extra>`};
  });
  const top = Math.max(10, ...traces.map((t) => 2 * t.x[t.x.length - 2]));
  const mark = (x) => ({type: "line", x0: x, x1: x, yref: "paper", y0: 0, y1: 1, layer: "below", line: {color: css("--quiet"), width: 1, dash: "dot"}});
  draw("ecdf", traces, {xaxis: log("gap to the best known cost of the state [%]", {range: [Math.log10(FLOOR), Math.log10(top)]}),
    yaxis: axis({title: {text: "initial states [%]"}, range: [0, 103]}), shapes: [mark(1), mark(5)]});
}
function drawCosts() {
  const last = M - 1, values = [], traces = [];
  for (let m = 0; m < last; m++) {
    const both = Array.from({length: B}, (_, i) => i).filter((i) => Number.isFinite(number(m, i, "cost")) && Number.isFinite(number(last, i, "cost")));
    traces.push({type: "scatter", mode: "markers", name: MNAMES[m], x: both.map((i) => number(last, i, "cost")), y: both.map((i) => number(m, i, "cost")),
      customdata: both, hovertext: both.map(hover), hoverinfo: "text", marker: {color: colour(m), size: 6, opacity: 0.7, symbol: ["circle", "square", "diamond", "triangle-up"][m % 4]}});
    both.forEach((i) => values.push(number(m, i, "cost"), number(last, i, "cost")));
  }
  if (!values.length) { draw("costs", [], {xaxis: axis(), yaxis: axis()}); return; }
  const low = values.reduce((a, b) => Math.min(a, b)), high = values.reduce((a, b) => Math.max(a, b));
  traces.push({type: "scatter", mode: "lines", name: "equal", x: [low, high], y: [low, high], line: {color: css("--quiet"), width: 1}, hoverinfo: "skip"});
  const kind = low > 0 && high > 20 * low ? (title) => log(title) : (title) => axis({title: {text: title}});
  draw("costs", traces, {xaxis: kind(`cost of ${MNAMES[last]}`), yaxis: kind(M === 2 ? `cost of ${MNAMES[0]}` : "cost of the others")});
}
const sliceValues = D.slices ? floats(D.slices.V) : null;
function drawSlice() {
  const S = D.slices, p = Number($("slicepair").value), q = Number($("slicetime").value), [i, k] = S.pairs[p], n = S.n;
  const at = (p * S.t.length + q) * n * n, grid = (c) => Array.from({length: n}, (_, a) => S.low[c] + (S.high[c] - S.low[c]) * a / (n - 1));
  const V = Array.from({length: n}, (_, r) => Array.from(sliceValues.slice(at + r * n, at + (r + 1) * n)));
  const known = V.flat().filter(Number.isFinite), high = known.reduce((a, b) => Math.max(a, b), 1e-12);
  const floor = Math.max(1e-4 * high, known.reduce((a, b) => Math.min(a, b), high));  // colours go by powers of ten
  const z = V.map((row) => row.map((v) => Math.log10(Math.max(v, floor)))), least = Math.log10(floor), most = Math.log10(high);
  const ticks = Array.from({length: 5}, (_, c) => least + (most - least) * c / 4);
  const traces = [{type: "contour", x: grid(i), y: grid(k), z, text: V.map((row) => row.map(text)), ncontours: 24, colorscale: dark.matches ? [[0, "#1b2026"], [1, "#5d7186"]] : [[0, "#f4f8fc"], [1, "#86add3"]],
    line: {width: 0.5, color: css("--quiet")}, colorbar: {title: {text: "V", side: "top"}, thickness: 10, outlinewidth: 0, len: 0.9,
    tickvals: ticks, ticktext: ticks.map((v) => String(Number((10 ** v).toPrecision(2))))}, opacity: 0.9,
    hovertemplate: `V = %{text}<extra>(%{x:.3g}, %{y:.3g})</extra>`}, ...obstacleTraces(i, k)];
  const shown = (D.kept || Array.from({length: B}, (_, s) => s));
  const step = Math.max(1, Math.ceil(shown.length / 30)), some = shown.filter((_, s) => s % step === 0), t = S.t[q];
  D.methods.forEach((method, m) => {
    const x = [], y = [], dots = [[], []];
    const node = method.t.reduce((best, v, c) => Math.abs(v - t) < Math.abs(method.t[best] - t) ? c : best, 0);
    some.forEach((s) => { const r = run(m, s); x.push(...r[i], null); y.push(...r[k], null); dots[0].push(r[i][node]); dots[1].push(r[k][node]); });
    traces.push({type: "scatter", mode: "lines", x, y, name: MNAMES[m], legendgroup: String(m), line: line(m, {width: 1.3}), opacity: 0.85, hoverinfo: "skip"});
    traces.push({type: "scatter", mode: "markers", x: dots[0], y: dots[1], name: MNAMES[m], legendgroup: String(m), showlegend: false, hoverinfo: "skip",
                 marker: {color: colour(m), size: 5, line: {width: 0.5, color: css("--back")}}});
  });
  const star = S.goal || (np ? null : D.goal);
  if (star) traces.push({type: "scatter", mode: "markers", x: [star[i]], y: [star[k]], showlegend: false, hoverinfo: "skip", marker: {symbol: "star", size: 12, color: css("--text")}});
  const rest = D.states.map((name, c) => [name, S.base[q][c], c]).filter(([, , c]) => c !== i && c !== k).map(([name, v]) => `${name} = ${text(v)}`).join(", ");
  $("slicenote").textContent = `V(x, t) of ${S.method} at t = ${text(t)}` + (rest ? `, with ${rest} (the median of its runs then)` : "") +
    (S.p ? `, at ${PARAMETERS.map((name, c) => `${name} = ${text(S.p[c])}`).join(", ")}` : np ? ", of the one p that it was made for" : "") +
    `. On top: ${some.length} runs of each method; dots: where they are at that time. Where others than these two coordinates matter, a run does not lie in the slice.`;
  draw("slice", traces, {xaxis: axis({title: {text: LABELS[i]}, range: [S.low[i], S.high[i]]}), yaxis: axis({title: {text: LABELS[k]}, range: [S.low[k], S.high[k]]})});
}
function drawTimes() {
  const traces = [];
  [["first answer", "first"], ["each later control", "later"]].forEach(([what, c]) => D.methods.forEach((_, m) => {
    const x = Array.from({length: B}, (_, i) => number(m, i, c)).filter((v) => Number.isFinite(v) && v > 0);
    if (x.length) traces.push({type: "box", orientation: "h", x, y: x.map(() => what), name: MNAMES[m], legendgroup: String(m), offsetgroup: String(m),
      showlegend: !traces.some((trace) => trace.legendgroup === String(m)), boxpoints: false, line: {color: colour(m), width: 1.5}, hoverinfo: "x+name"});
  }));
  draw("times", traces, {boxmode: "group", xaxis: log("milliseconds"), yaxis: axis({autorange: "reversed"})});
}
function drawRobust() {
  const names = D.robustness.map((scenario) => safe(scenario.name)), methods = [...new Set(D.robustness.flatMap((s) => s.losses.map((x) => x.method)))];
  const traces = methods.map((method, c) => {
    const m = D.methods.findIndex((known) => known.name === method), x = [], y = [];
    D.robustness.forEach((scenario, s) => scenario.losses.filter((loss) => loss.method === method).forEach((loss) =>
      floats(loss.lost).forEach((v) => { if (Number.isFinite(v)) { x.push(names[s]); y.push(Math.max(v, LOSS_FLOOR)); } })));
    return {type: "box", x, y, name: safe(method), boxpoints: false, line: {color: colour(m < 0 ? M + c : m), width: 1.5}, offsetgroup: String(c)};
  });
  draw("robust", traces, {boxmode: "group", yaxis: log("cost lost [%]"), xaxis: axis({type: "category", categoryorder: "array", categoryarray: names})});
}
function drawPoles() {
  const traces = D.stability.map((s, c) => {
    const m = D.methods.findIndex((known) => known.name === s.method);
    return {type: "scatter", mode: "markers", name: `${safe(s.method)}, ${safe(s.where)}`, x: Array.from(floats(s.re)), y: Array.from(floats(s.im)),
            marker: {color: colour(m < 0 ? M + c : m), symbol: s.where === "goal" ? "x" : "circle-open", size: 8}};
  });
  draw("poles", traces, {xaxis: axis({title: {text: "real part [1/time]"}}), yaxis: axis({title: {text: "imaginary part"}}),
    shapes: [{type: "line", x0: 0, x1: 0, yref: "paper", y0: 0, y1: 1, line: {color: css("--quiet"), width: 1.5}}]});
}
const regionColour = (name, c) => { const m = D.methods.findIndex((known) => known.name === name); return colour(m < 0 ? M + c : m); };
function drawRegion() {
  const traces = D.regions.map((r, c) => ({type: "scatter", mode: "lines+markers", name: safe(r.method), x: r.scale, y: r.share.map((v) => 100 * v),
    line: {color: regionColour(r.method, c), dash: DASH[c % DASH.length]}, error_y: {type: "data", symmetric: false, thickness: 1,
    array: r.upper.map((v, k) => 100 * (v - r.share[k])), arrayminus: r.lower.map((v, k) => 100 * (r.share[k] - v))}}));
  draw("region", traces, {xaxis: axis({title: {text: "scale of the spread of initial states"}}),
    yaxis: axis({title: {text: `within ${text(D.regions[0].within)} % of the best known cost [% of states]`}, range: [0, 104]})});
}
function drawRegionMap() {
  const r = D.regions[Number($("regionof").value)], i = Number($("regionx").value), k = Number($("regiony").value), all = floats(r.x0);
  const traces = [[1, "succeeded", "circle", regionColour(r.method, 0)], [0, "failed", "x", css("--text")]].map(([won, name, symbol, shade]) => {
    const rows = r.success.map((v, s) => v === won ? s : -1).filter((s) => s >= 0);
    return {type: "scatter", mode: "markers", name, x: rows.map((s) => all[s * nx + i]), y: rows.map((s) => all[s * nx + k]),
            hoverinfo: "x+y", marker: {symbol, color: shade, size: 6, opacity: 0.75}};
  });
  draw("regionmap", traces, {xaxis: axis({title: {text: LABELS[i]}}), yaxis: axis({title: {text: LABELS[k]}})});
}

// ---- selects, and what is drawn when ------------------------------------------------------------------------------------
function fill(id, options, value) {
  options.forEach(([key, label]) => $(id).add(new Option(label, key)));
  $(id).value = String(value);
}
function spread(values) {  // coordinates of rows [n, nx] by their spread, the widest first, those that do not move last
  const rows = values.length / nx, sd = D.states.map((_, k) => {
    let sum = 0, squares = 0;
    for (let i = 0; i < rows; i++) { sum += values[i * nx + k]; squares += values[i * nx + k] ** 2; }
    return Math.sqrt(Math.max(squares / rows - (sum / rows) ** 2, 0));
  });
  return D.states.map((_, k) => k).filter((k) => sd[k] > 1e-9).concat(D.states.map((_, k) => k).filter((k) => sd[k] <= 1e-9));
}
const coordinates = D.states.map((name, k) => [String(k), D.labels[k]]);
const order = spread(X0), plane = D.plane.filter((k) => k < nx && order.indexOf(k) >= 0);
const moving = order.slice(0, 2);
const axes = plane.length === 2 && plane.every((k) => moving.includes(k)) ? plane : moving;
const starting = coordinates.concat(PARAMETERS.map((_, k) => [String(nx + nu + k), D.plabels[k]]));
fill("across", starting, axes[0]);
fill("up", [["gap", "gap"], ...starting], axes.length > 1 ? axes[1] : "gap");
fill("colour", D.methods.map((method, m) => [String(m), "gap of " + method.name]), D.explained);
fill("phasex", D.labels.map((label, k) => [String(k), label]), D.plane[0]);
fill("phasey", D.labels.map((label, k) => [String(k), label]), D.plane[1]);
if (D.slices) {
  fill("slicepair", D.slices.pairs.map(([i, k], p) => [String(p), `${D.states[i]}, ${D.states[k]}`]), 0);
  fill("slicetime", D.slices.t.map((t, q) => [String(q), "t = " + text(t)]), 0);
}
if (D.regions.length) {
  fill("regionof", D.regions.map((r, c) => [String(c), r.method]), 0);
  fill("regionx", coordinates, axes[0]);
  fill("regiony", coordinates, axes[axes.length - 1]);
}
const PLOTS = {map: drawMap, panel: drawState, ecdf: drawEcdf, costs: drawCosts, slice: drawSlice, times: drawTimes, robust: drawRobust,
               poles: drawPoles, region: drawRegion, regionmap: drawRegionMap};
const here = Object.keys(PLOTS).filter((id) => $(id)), drawn = new Set();
function show(id) {
  drawn.add(id);
  PLOTS[id]();
  if ((id === "map" || id === "costs") && !$(id).dataset.bound) {
    $(id).dataset.bound = "1";
    $(id).on("plotly_click", (event) => {
      const i = event.points[0].customdata;
      if (i === undefined) return;
      choose(i);
      if (id === "costs") $("panel").scrollIntoView();
    });
  }
}
const waiting = [];  // drawn one at a time, so that the page answers in between
function drawNext() {
  const id = waiting.shift();
  if (id && !drawn.has(id)) show(id);
  if (waiting.length) setTimeout(drawNext);
}
const near = new IntersectionObserver((entries) => entries.filter((entry) => entry.isIntersecting).forEach((entry) => {
  near.unobserve(entry.target);
  if (waiting.push(entry.target.id) === 1) setTimeout(drawNext);
}), {rootMargin: "400px"});
["across", "up", "colour"].forEach((id) => $(id).addEventListener("change", drawMap));
["phasex", "phasey"].forEach((id) => $(id).addEventListener("change", drawPhase));
if (D.slices) ["slicepair", "slicetime"].forEach((id) => $(id).addEventListener("change", drawSlice));
if (D.regions.length) ["regionof", "regionx", "regiony"].forEach((id) => $(id).addEventListener("change", drawRegionMap));
$("models").parentElement.hidden = !AUDITS.some((audit) => audit.rollouts.length);
$("models").addEventListener("change", drawRuns);
$("number").addEventListener("change", () => choose(Number($("number").value)));
$("previous").addEventListener("click", () => choose((state + B - 1) % B));
$("next").addEventListener("click", () => choose((state + 1) % B));
document.querySelectorAll("button.show").forEach((button) => button.addEventListener("click", () => {
  choose(Number(button.dataset.state));
  $("panel").scrollIntoView();
}));
dark.addEventListener("change", () => drawn.forEach((id) => show(id)));
let wide = window.innerWidth;
window.addEventListener("resize", () => {  // the runs are laid out anew; plotly scales the rest by itself
  if (window.innerWidth !== wide && drawn.has("panel")) { wide = window.innerWidth; drawRuns(); }
});
const first = document.querySelector("button.show");
state = first ? Number(first.dataset.state) : 0;
here.forEach((id) => near.observe($(id)));
document.body.dataset.ready = "1";
})();
