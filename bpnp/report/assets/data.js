"use strict";

// The data of the page, its columns unpacked when first asked for.

const DATA = JSON.parse(document.getElementById("data").textContent);
const KINDS = { f4: Float32Array, i4: Int32Array, u2: Uint16Array, i2: Int16Array, u1: Uint8Array };
const unpacked = new WeakMap();

function column(packed) {
  if (!unpacked.has(packed)) {
    const kind = Object.keys(KINDS).find((name) => name in packed);
    const text = atob(packed[kind]);
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    unpacked.set(packed, new KINDS[kind](bytes.buffer));
  }
  return unpacked.get(packed);
}

// One entry per run and estimate: what the buttons at the top show and hide.
const SERIES = DATA.runs.flatMap((run) =>
  Object.entries(run.estimates).map(([estimate, own]) => ({
    run,
    estimate,
    name: DATA.runs.length > 1 ? `${run.name}: ${estimate}` : estimate,
    colour: `var(--c${own.colour})`,
    dashes: own.dashes.join(" "),
    cells: own.cells,
    shown: true,
    get: (key) => column(own.columns[key]),
    size: (key) => column(run.sizes[key]),
    ids: DATA.ids[run.ids],
  })),
);

const shownSeries = () => SERIES.filter((series) => series.shown);

// Three significant digits, as in the tables of the terminal.
function number(value) {
  const size = Math.abs(value);
  if (Number.isNaN(value)) return "nan";
  if (size === Infinity) return value > 0 ? "inf" : "-inf";
  if (size === 0) return "0";
  if (size >= 0.01 && size < 999.5) return value.toPrecision(3);
  if (size >= 0.001 && size < 0.01) return value.toFixed(4);
  if (size >= 999.5 && size < 99999.5) return value.toFixed(0);
  return value.toExponential(size < 1e-9 ? 0 : 1).replace("+", "");
}

// The linear interpolation between order statistics that the tables use; infinite beside an infinite neighbour.
function quantile(sorted, share) {
  const position = share * (sorted.length - 1);
  const [below, above] = [sorted[Math.floor(position)], sorted[Math.ceil(position)]];
  return above === Infinity ? above : below + (above - below) * (position % 1);
}

// Number of values <= limit in a sorted array.
function countUpTo(sorted, limit) {
  let [low, high] = [0, sorted.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (sorted[middle] <= limit) low = middle + 1;
    else high = middle;
  }
  return low;
}

// Elements from text only: no name in the data is ever read as HTML.
function element(tag, attributes = {}, ...children) {
  return filled(document.createElement(tag), attributes, children);
}

function shape(tag, attributes = {}, ...children) {
  return filled(document.createElementNS("http://www.w3.org/2000/svg", tag), attributes, children);
}

function filled(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (value !== null) node.setAttribute(name, value);
  }
  node.append(...children);
  return node;
}

const byId = (id) => document.getElementById(id);
