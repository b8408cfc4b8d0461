"use strict";
// What the address keeps, the tables, the charts and the list of problems. Data and plotly are gzip in base64.

const [PICTURES, MOST] = [12, 1250];
const byId = (id) => document.getElementById(id);
const each = (selector, act) => document.querySelectorAll(selector).forEach(act);
const dark = matchMedia("(prefers-color-scheme: dark)");
let [DATA, LINES, SERIES, chosen] = [{}, [], [], []];

const ink = (name) => DATA.inks[name][Number(dark.matches)];
const column = (series, key) => (series[key] ??= DATA.columns[series.numbers[key]].map(Number));
const number = (value) => (Number.isFinite(value) ? String(Number(value.toPrecision(3))) : { Infinity: "inf" }[value] ?? "nan");
const listed = () => SERIES[byId("list").value] ?? SERIES[0];
const shown = (series) => byId(`series${series}`)?.checked ?? true;

async function inflated(id) {
  const text = atob(byId(id).textContent);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
}

// Elements from text only: no name in the data is ever read as HTML.
function element(tag, attributes, ...children) {
  const node = Object.assign(document.createElement(tag), attributes);
  node.append(...children);
  return node;
}

// The address keeps every [data-state] that is not as the page was written.
const states = [...document.querySelectorAll("[data-state]")];
const held = (node) => (node.type === "checkbox" ? String(node.checked) : node.value);
const written = states.map(held);

function setState(changes) {
  for (const [id, value] of Object.entries(changes)) {
    const node = byId(id);
    if (node?.type === "checkbox") node.checked = value === "true";
    else if (node) node.value = value;
  }
  const kept = states.filter((node, k) => held(node) !== written[k]).map((node) => [node.id, held(node)]);
  history.replaceState(null, "", `#${new URLSearchParams(kept)}`);
}

// Figures are made in the colours of the light scheme; the dark scheme has one for each.
function themed(text) {
  if (dark.matches) for (const [light, night] of Object.values(DATA.inks)) text = text.replaceAll(`"${light}"`, `"${night}"`);
  return JSON.parse(text);
}

function draw(node, { data, layout }, config, click) {
  Plotly.react(node, data, { ...layout, template: themed(DATA.look) }, { ...DATA.config, ...config });
  node.removeAllListeners("plotly_click");
  if (click) node.on("plotly_click", ({ points: [point] }) => click(point));
}

// Draws when the reader comes near.
const watcher = new IntersectionObserver((entries) => entries.forEach(({ isIntersecting, target }) => {
  if (!isIntersecting) return;
  watcher.unobserve(target);
  target.show();
}), { rootMargin: "300px" });

function watch(node, show) {
  node.show = show;
  watcher.observe(node);
}

function drawChart(node) {
  const figure = themed(DATA.charts[node.dataset.chart]);
  for (const trace of figure.data) trace.visible = trace.meta == null || shown(trace.meta);
  draw(node, figure);
}

function drawSeries() {
  each("tr[data-series]", (row) => { row.hidden = !shown(row.dataset.series); });
  each(".js-plotly-plot[data-chart]", drawChart);
}

// Run against run: the rotation errors of two series, of many problems those that differ most and others between.
function drawComparison() {
  const [a, b] = ["a", "b"].map((id) => SERIES[byId(id).value]);
  const place = new Map(b.problems.map((problem, i) => [problem, i]));
  const [x, y] = [a, b].map((series) => column(series, "rotation_error_deg"));
  const common = [...a.ids.keys()].filter((i) => place.has(a.problems[i]));
  const problems = common.map((i) => ({ i, id: a.ids[i], x: x[i], y: y[place.get(a.problems[i])] }));
  const share = (part) => `${((100 * part.length) / Math.max(problems.length, 1)).toFixed(1)} %`;
  byId("versus-text").textContent = byId("versus").ariaLabel =
    `${a.name} has the smaller rotation error in ${share(problems.filter(({ x, y }) => x < y))} of ${problems.length} ` +
    `common problems, ${b.name} in ${share(problems.filter(({ x, y }) => y < x))}.`;
  const gap = ({ x: own, y: other }) => Math.abs(Math.log((own + 1e-9) / (other + 1e-9)));
  const between = Math.ceil(problems.length / MOST);
  const drawn = problems.sort((p, q) => gap(q) - gap(p)).filter((_, k) => k < MOST || k % between === 0);
  const figure = themed(DATA.figures.versus);
  const all = (key, least) => drawn.map((problem) => (least ? Math.max(problem[key], least) : problem[key]));
  Object.assign(figure.data[0], { x: all("x", 1e-4), y: all("y", 1e-4), text: all("id"), customdata: all("i") });
  [figure.layout.xaxis.title, figure.layout.yaxis.title] = [a, b].map(({ name }) => ({ text: `${name}, degrees` }));
  draw(byId("versus"), figure, {}, ({ customdata }) => {
    setState({ list: byId("a").value });
    drawProblems();
    openProblem(customdata);
  });
}

// Positions of the problems that pass the filters, sorted; undefined errors last.
function selectProblems() {
  const series = listed();
  const [cause, error] = ["cause", "rotation_error_deg"].map((key) => column(series, key));
  const wanted = byId("cause").value;
  const found = [...series.ids.keys()].filter((i) => (wanted === "" || Number(wanted) === cause[i]) &&
    error[i] >= Number(byId("least").value) &&
    series.ids[i].toLowerCase().includes(byId("name").value.toLowerCase()));
  const [sort, sign] = [byId("sort").value, byId("up").checked ? 1 : -1];
  const values = sort === "id" ? series.ids : sort in series.numbers ? column(series, sort) : error;
  const order = (a, b) => (values[a] === values[b] ? 0 : sign * (values[a] < values[b] ? -1 : 1));
  return found.sort((a, b) => Number.isNaN(values[a]) - Number.isNaN(values[b]) || order(a, b) || a - b);
}

function problemRow(series, i, ...head) {
  const cause = column(series, "cause")[i];
  return element("tr", {}, element("th", { scope: "row" }, ...head),
    ...DATA.keys.map((key) => element("td", {}, number(column(series, key)[i]))),
    element("td", { className: "words" }, element("span", { className: `fill cause${cause}` }), ` ${DATA.causes[cause]}`));
}

function drawProblems() {
  const series = listed();
  chosen = selectProblems();
  const rows = chosen.slice(0, Number(byId("rows").value));
  each("#problem-table [data-key]", ({ dataset, parentNode }) => {
    parentNode.ariaSort = dataset.key !== byId("sort").value ? "none" : byId("up").checked ? "ascending" : "descending";
  });
  const link = (i) => element("button", { className: "link", onclick: () => openProblem(i) },
    `${series.lines[i] >= 0 ? "◉ " : ""}${series.ids[i]}`);
  byId("problem-table").tBodies[0].replaceChildren(...rows.map((i) => problemRow(series, i, link(i))));
  byId("more").hidden = rows.length === chosen.length;
  byId("place").textContent = `${rows.length} shown · ${chosen.length} of ${series.ids.length} problems`;
  const pictured = chosen.filter((i) => series.lines[i] >= 0).slice(0, PICTURES);
  byId("gallery").replaceChildren(...pictured.map((i) => thumbnail(series, i)));
}

async function start() {
  document.head.append(element("script", {}, await inflated("plotly")));
  DATA = JSON.parse(await inflated("data"));
  let lines;
  [lines, ...LINES] = (await inflated("points")).split("\n");
  SERIES = DATA.series.map((own) => ({ ...own, ids: DATA.columns[own.ids], problems: DATA.columns[own.problems],
    lines: JSON.parse(lines)[own.run] }));
  setState(Object.fromEntries(new URLSearchParams(location.hash.slice(1))));
  document.addEventListener("input", ({ target }) => {
    if (target.matches("#problem *")) return drawProblem();
    setState({});
    return target.matches("#series *") ? drawSeries() : target.matches("#versus-section *") ? drawComparison() : drawProblems();
  });
  each("nav a", (link) => { link.onclick = () => document.querySelector(link.hash).scrollIntoView() ?? false; });
  each("#problem-table [data-key]", (button) => { button.onclick = () => {
    const again = byId("sort").value === button.dataset.key;
    setState({ up: String(again && !byId("up").checked), sort: button.dataset.key });
    drawProblems();
  }; });
  byId("more").onclick = () => { setState({ rows: Number(byId("rows").value) + 25 }); drawProblems(); };
  byId("previous").onclick = () => step(-1);
  byId("next").onclick = () => step(1);
  byId("problem").onclose = () => setState({ open: "" });
  byId("problem").onkeydown = ({ key, target }) => {
    if (!target.matches("select, input")) step({ ArrowLeft: -1, ArrowRight: 1 }[key]);
  };
  each("[data-chart]", (node) => watch(node, () => drawChart(node)));
  if (byId("versus")) watch(byId("versus"), drawComparison);
  addEventListener("beforeprint", () => each(".chart", (node) => node.show()));
  dark.onchange = () => { each(".js-plotly-plot", (node) => node.show()); };
  drawSeries();
  drawProblems();
  const i = listed().ids.indexOf(byId("open").value);
  if (i >= 0) openProblem(i);
  document.documentElement.dataset.ready = "1";
}
