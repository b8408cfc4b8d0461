// The list of pairs, worst first, a page at a time.

const ROWS = 25;
const pairSort = { column: "rotation_error_deg", descending: true };
const PAIR_COLUMNS = [
  ["rotation_error_deg", "rot deg"], ["translation_error", "trans"], ["centre_error", "centre"],
  ["reprojection_error_deg", "repr deg"], ["inliers", "inliers"], ["m", "2D points"], ["n", "3D points"],
  ["true_pairs", "true pairs"], ["iterations", "iterations"], ["seconds", "sec"],
];
const WHOLE = new Set(["inliers", "m", "n", "true_pairs", "iterations"]);
let pairPage = 0;
let listed = [];

const pairColumn = (series, key) => (["m", "n", "true_pairs"].includes(key) ? series.size(key) : series.get(key));
const pairText = (key, value) => (WHOLE.has(key) ? String(value) : number(value));
const listedSeries = () => SERIES[byId("pair-series").value];

function preparePairs() {
  byId("pair-series").append(...SERIES.map((series, i) => element("option", { value: i }, series.name)));
  byId("pair-cause").append(element("option", { value: "" }, "any"),
    ...DATA.causes.map((cause, i) => element("option", { value: i }, cause)));
  for (const id of ["pair-series", "pair-cause", "pair-filter", "pair-drawn"]) {
    byId(id).addEventListener("input", () => {
      pairPage = 0;
      drawPairs();
    });
  }
}

// Positions of the pairs that pass the filters, sorted; undefined errors last.
function selectPairs() {
  const series = listedSeries();
  const [wanted, cause, drawn] = [byId("pair-filter").value, byId("pair-cause").value, byId("pair-drawn").checked];
  const causes = series.get("cause");
  const chosen = [];
  series.ids.forEach((id, i) => {
    if (wanted && !id.toLowerCase().includes(wanted.toLowerCase())) return;
    if (cause !== "" && causes[i] !== Number(cause)) return;
    if (drawn && !hasPoints(series.run, i)) return;
    chosen.push(i);
  });
  if (pairSort.column === "id") {
    chosen.sort((a, b) => series.ids[a].localeCompare(series.ids[b]) * (pairSort.descending ? -1 : 1));
  } else {
    const values = pairColumn(series, pairSort.column);
    const sign = pairSort.descending ? -1 : 1;
    // Two infinities have no difference.
    const compare = (a, b) => (values[a] === values[b] ? 0 : sign * (values[a] < values[b] ? -1 : 1));
    chosen.sort((a, b) => Number.isNaN(values[a]) - Number.isNaN(values[b]) || compare(a, b) || a - b);
  }
  return chosen;
}

function drawPairs() {
  const series = listedSeries();
  listed = selectPairs();
  const pages = Math.max(1, Math.ceil(listed.length / ROWS));
  pairPage = Math.min(pairPage, pages - 1);
  const rows = listed.slice(pairPage * ROWS, (pairPage + 1) * ROWS).map((i) =>
    element("tr", {}, element("th", { scope: "row" },
      element("button", { type: "button", class: hasPoints(series.run, i) ? "link drawn" : "link", onclick: () => openPair(i) },
        ...breakable(series.ids[i] || "(no name)"))),
      ...PAIR_COLUMNS.map(([key]) => element("td", {}, pairText(key, pairColumn(series, key)[i]))),
      element("td", { class: "words" }, DATA.causes[series.get("cause")[i]])));
  const sortAgain = () => {
    pairPage = 0;
    drawPairs();
  };
  const heads = PAIR_COLUMNS.map(([key, text]) => sortHead(text, key, pairSort, sortAgain, true));
  byId("pair-table").replaceChildren(
    element("thead", {}, element("tr", {}, sortHead("pair", "id", pairSort, sortAgain, false), ...heads,
      element("th", { scope: "col", class: "words" }, "cause"))),
    element("tbody", {}, ...rows));
  drawPager(pages);
  const kept = series.ids.reduce((sum, _, i) => sum + hasPoints(series.run, i), 0);
  byId("pair-kept").textContent = `Points to look at (◉): of ${kept === series.ids.length ? "all" : kept} of the `
    + `${series.ids.length} pairs; of ${Object.keys(series.run.views).length} up to 300 a side, of the others up to 24.`;
}

// A path that does not fit in a line is broken behind a slash.
const breakable = (name) => name.split(/(?<=\/)/).flatMap((part, k) => (k ? [element("wbr"), part] : [part]));

function drawPager(pages) {
  const turn = (by) => () => {
    pairPage += by;
    drawPairs();
    byId(by < 0 ? "page-back" : "page-on").focus();
  };
  byId("pager").replaceChildren(
    element("button", { type: "button", id: "page-back", onclick: turn(-1), disabled: pairPage === 0 ? "" : null }, "← back"),
    element("span", { role: "status" }, `${pairPage + 1} / ${pages} · ${listed.length} pairs`),
    element("button", { type: "button", id: "page-on", onclick: turn(1), disabled: pairPage === pages - 1 ? "" : null }, "on →"));
}
