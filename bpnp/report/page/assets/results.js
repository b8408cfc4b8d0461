"use strict";
// What the address keeps (filters, hidden series, the pair that is open), columns of numbers, and the charts.

const byId = (id) => document.getElementById(id);
const DATA = JSON.parse(byId("data").textContent);
const KINDS = { f4: Float32Array, i4: Int32Array, u2: Uint16Array, i2: Int16Array, u1: Uint8Array };
const unpacked = new WeakMap();
const dark = matchMedia("(prefers-color-scheme: dark)");
const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
const ink = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`);
const number = (value) => (Number.isFinite(value) ? String(Number(value.toPrecision(3))) : String(value).replace("Infinity", "inf"));

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
    else node.setAttribute(name, value);
  }
  node.append(...children);
  return node;
}

// One entry per run and estimate, in the order of the buttons at the top.
const SERIES = DATA.runs.flatMap((run) => Object.entries(run.estimates).map(([estimate, own]) => ({
  run, estimate, name: DATA.runs.length > 1 ? `${run.name}: ${estimate}` : estimate, key: `${run.name}: ${estimate}`,
  index: own.colour, ids: DATA.ids[run.ids], get: (name) => column(own.columns[name] ?? run.sizes[name]),
})));
const shown = (series) => !state.hidden.split(" ").includes(String(SERIES.indexOf(series)));

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

// Figures are made in the colours of the light scheme; the dark scheme has one for each.
function themed(text) {
  if (dark.matches) DATA.colours[0].forEach((light, i) => { text = text.replaceAll(`"${light}"`, `"${DATA.colours[1][i]}"`); });
  return JSON.parse(text);
}

function draw(node, { data, layout }, config = {}) {
  return Plotly.react(node, data, { ...layout, template: themed(DATA.look) }, { responsive: true, displaylogo: false,
    toImageButtonOptions: { scale: 2, filename: "bpnp" }, modeBarButtonsToRemove: DATA.buttons, ...config });
}

function drawChart(node) {
  const figure = themed(DATA.charts[node.dataset.chart]);
  const hidden = new Set(SERIES.filter((series) => !shown(series)).map(({ key }) => key));
  for (const trace of figure.data) trace.visible = !hidden.has(trace.legendgroup);
  return draw(node, figure);
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
  body.prepend(...[...body.querySelectorAll("[data-series]")].sort((a, b) => (down ? -1 : 1) * (value(a) - value(b) || 0)));
}

// Run against run: the errors of two series pair by pair; of many, those that differ most and others between.
const MOST = 2500;
function drawComparison() {
  if (!byId("versus")) return;
  const [a, b] = [SERIES[state.a], SERIES[state.b]];
  const place = new Map(b.ids.map((id, i) => [id, i]));
  const errors = [a, b].map((series) => series.get("rotation_error_deg"));
  const pairs = a.ids.map((id, i) => ({ i, id, x: errors[0][i], y: errors[1][place.get(id)] })).filter(({ id }) => place.has(id));
  const share = (found) => `${((100 * found.length) / Math.max(pairs.length, 1)).toFixed(1)} %`;
  byId("versus-text").textContent = `${a.name} has the smaller rotation error in ${share(pairs.filter(({ x, y }) => x < y))} of ` +
    `${pairs.length} common pairs, ${b.name} in ${share(pairs.filter(({ x, y }) => y < x))}.` +
    (pairs.length > MOST ? ` Drawn are ${MOST}: half the largest differences, half spread.` : "");
  const gap = ({ x, y }) => Math.abs(Math.log((x + 1e-9) / (y + 1e-9)));
  const spread = pairs.filter((_, k) => k % Math.ceil((2 * pairs.length) / MOST) === 0);
  const drawn = pairs.length <= MOST ? pairs : [...[...pairs].sort((p, q) => gap(q) - gap(p)).slice(0, MOST / 2), ...spread];
  const figure = themed(DATA.figures.versus);
  Object.assign(figure.data[0], { x: drawn.map(({ x }) => Math.max(x, 1e-4)), y: drawn.map(({ y }) => Math.max(y, 1e-4)),
    text: drawn.map(({ id }) => id), customdata: drawn.map(({ i }) => i) });
  [figure.layout.xaxis, figure.layout.yaxis].forEach((axis, k) => { axis.title = { text: `${[a, b][k].name}, degrees` }; });
  draw("versus", figure);
  byId("versus").setAttribute("aria-label", byId("versus-text").textContent);
}
