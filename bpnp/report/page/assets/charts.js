"use strict";
// Columns, colours and charts, and what the address keeps: filters, hidden series, the pair that is open.

const byId = (id) => document.getElementById(id);
const DATA = JSON.parse(byId("data").textContent);
const KINDS = { f4: Float32Array, i4: Int32Array, u2: Uint16Array, i2: Int16Array, u1: Uint8Array };
const unpacked = new WeakMap();
const dark = matchMedia("(prefers-color-scheme: dark)");
const CONFIG = { responsive: true, displaylogo: false, toImageButtonOptions: { format: "png", scale: 2, filename: "bpnp" },
  modeBarButtonsToRemove: ["sendChartToCloud", "select2d", "lasso2d", "autoScale2d", "tableRotation", "resetCameraLastSave3d"] };

function bytes(text) {
  return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
}

function column(packed) {
  const [kind] = Object.keys(packed);
  if (!unpacked.has(packed)) unpacked.set(packed, new KINDS[kind](bytes(packed[kind]).buffer));
  return unpacked.get(packed);
}

// Elements from text only: no name in the data is ever read as HTML.
function element(tag, attributes = {}, ...children) {
  const svg = ["svg", "circle", "path", "image"].includes(tag);
  const node = svg ? document.createElementNS("http://www.w3.org/2000/svg", tag) : document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (value !== null && value !== false) node.setAttribute(name, value);
  }
  node.append(...children);
  return node;
}

// One entry per run and estimate, in the order of the buttons at the top.
const SERIES = DATA.runs.flatMap((run) => Object.entries(run.estimates).map(([estimate, own]) => ({
  run, estimate, name: DATA.runs.length > 1 ? `${run.name}: ${estimate}` : estimate, key: `${run.name}: ${estimate}`,
  index: own.colour, dash: own.dash, ids: DATA.ids[run.ids],
  get: (name) => column(own.columns[name] ?? run.sizes[name]),
})));
const colour = (series) => DATA.colours[dark.matches ? 1 : 0][series.index];
const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const shown = (series) => !state.hidden.split(" ").includes(String(SERIES.indexOf(series)));

const number = (value) => (Number.isFinite(value) ? String(Number(value.toPrecision(3))) : String(value).replace("Infinity", "inf"));

const DEFAULTS = { list: "0", cause: "", status: "", least: "", name: "", drawn: "", sort: "rotation_error_deg", up: "",
  page: "0", hidden: "", a: "0", b: "1", pair: "" };
// Names that are not UTF-8 hold lone surrogates, which addresses cannot.
const wellFormed = (text) => text.replace(/\p{Surrogate}/gu, "\ufffd");
const state = { ...DEFAULTS, ...Object.fromEntries(new URLSearchParams(location.hash.slice(1))) };

function setState(changes) {
  Object.assign(state, changes);
  const kept = Object.entries(state).filter(([key, value]) => key in DEFAULTS && value !== DEFAULTS[key]);
  history.replaceState(null, "", `#${new URLSearchParams(kept)}`);
}

function theme(layout) {
  const axis = { gridcolor: css("--line"), zerolinecolor: css("--line"), linecolor: css("--quiet"), automargin: true };
  const text = { color: css("--text"), size: 11 };
  const clear = "rgba(0,0,0,0)";
  return { margin: { l: 50, r: 12, t: 44, b: 40 }, showlegend: false, paper_bgcolor: clear, plot_bgcolor: clear, font: text,
    hoverlabel: { namelength: 60 }, modebar: { bgcolor: clear, color: css("--quiet"), activecolor: css("--focus") }, ...layout,
    title: { ...layout.title, x: 0.02, xanchor: "left", font: { size: 13 } },
    xaxis: { ...axis, ...layout.xaxis }, yaxis: { ...axis, ...layout.yaxis } };
}

// Figures are made in the colours of the light scheme; the dark scheme has one for each.
function drawChart(node) {
  let text = DATA.charts[node.dataset.chart];
  if (dark.matches) DATA.colours[0].forEach((light, i) => { text = text.replaceAll(`"${light}"`, `"${DATA.colours[1][i]}"`); });
  const figure = JSON.parse(text);
  const hidden = new Set(SERIES.filter((series) => !shown(series)).map(({ key }) => key));
  const traces = figure.data.map((trace) => ({ ...trace, visible: !hidden.has(trace.legendgroup) }));
  figure.layout.shapes?.forEach((shape) => { shape.line.color = css("--quiet"); });
  return Plotly.react(node, traces, theme(figure.layout), CONFIG);
}

function drawSeries() {
  for (const node of document.querySelectorAll("[data-series]")) {
    const on = shown(SERIES[node.dataset.series]);
    if (node.tagName === "BUTTON") node.setAttribute("aria-pressed", on);
    else node.hidden = !on;
  }
  document.querySelectorAll(".chart.js-plotly-plot[data-chart]").forEach(drawChart);
}

// A table whose heads sort its rows by the number in data-value; the published rows stay beneath.
function sortTable(button) {
  const [head, body] = [button.closest("th"), button.closest("table").tBodies[0]];
  const down = head.getAttribute("aria-sort") === "ascending";
  head.parentNode.querySelectorAll("[aria-sort]").forEach((other) => other.removeAttribute("aria-sort"));
  head.setAttribute("aria-sort", down ? "descending" : "ascending");
  const value = (row) => Number(row.cells[head.cellIndex].dataset.value ?? Infinity);
  const rows = [...body.querySelectorAll("[data-series]")].sort((a, b) => (down ? -1 : 1) * (value(a) - value(b) || 0));
  body.prepend(...rows);
}

// Run against run: the errors of two series pair by pair; of many, those that differ most and others between.
const MOST = 2500;
function drawComparison() {
  const node = byId("versus");
  if (!node) return;
  const [a, b] = [SERIES[state.a], SERIES[state.b]];
  const place = a.ids === b.ids ? null : new Map(b.ids.map((id, i) => [id, i]));
  const [left, right] = [a.get("rotation_error_deg"), b.get("rotation_error_deg")];
  const pairs = a.ids.map((id, i) => [i, place ? place.get(id) : i]).filter(([, j]) => j !== undefined);
  const [better, worse] = [-1, 1].map((sign) => pairs.filter(([i, j]) => Math.sign(left[i] - right[j]) === sign).length);
  const share = (count) => `${((100 * count) / Math.max(pairs.length, 1)).toFixed(1)} %`;
  byId("versus-text").textContent = `${a.name} has the smaller rotation error in ${share(better)} of ${pairs.length} common pairs, ` +
    `${b.name} in ${share(worse)}.` + (pairs.length > MOST ? ` Drawn are ${MOST}: half the largest differences, half spread.` : "");
  const gap = ([i, j]) => Math.abs(Math.log((left[i] + 1e-9) / (right[j] + 1e-9)));
  const stride = Math.ceil((2 * pairs.length) / MOST);
  const drawn = pairs.length <= MOST ? pairs
    : [...[...pairs].sort((p, q) => gap(q) - gap(p)).slice(0, MOST / 2), ...pairs.filter((_, k) => k % stride === 0)];
  const floor = (value) => Math.max(value, 1e-4);
  const [x, y] = [drawn.map(([i]) => floor(left[i])), drawn.map(([, j]) => floor(right[j]))];
  const axis = (name) => ({ type: "log", tickformat: "~g", title: { text: `${name}, degrees` } });
  Plotly.react(node, [
    { x: [1e-4, 180], y: [1e-4, 180], mode: "lines", line: { color: css("--quiet"), width: 1, dash: "dash" }, hoverinfo: "skip" },
    { x, y, mode: "markers", marker: { size: 5, color: colour(a), opacity: 0.55 }, text: drawn.map(([i]) => a.ids[i]),
      customdata: drawn.map(([i]) => i), hovertemplate: "%{text}<br>%{x:.3g} against %{y:.3g} deg<extra></extra>" },
  ], theme({ xaxis: axis(a.name), yaxis: axis(b.name), hovermode: "closest", title: { text: "Rotation error of each pair" } }), CONFIG);
  node.setAttribute("aria-label", byId("versus-text").textContent);
}
