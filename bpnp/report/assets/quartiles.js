// The table of quartiles, its numbers as the terminal shows them, and the details of runs.

const quartileSort = { column: null, descending: false };

function drawQuartiles() {
  const rows = shownSeries();
  if (quartileSort.column !== null) {
    const value = (series) => series.cells[quartileSort.column][1] ?? Infinity;
    rows.sort((a, b) => (quartileSort.descending ? value(b) - value(a) : value(a) - value(b)));
  }
  const best = DATA.columns.map((column, i) => bestText(rows, i, column.share));
  const body = rows.map((series) =>
    element("tr", {}, element("th", { scope: "row" }, swatch(series), series.name),
      ...series.cells.map(([text, value], i) =>
        element("td", { class: text === best[i] ? "best" : null, title: value === null ? null : String(value) }, text))));
  const paper = DATA.paper.map((row) =>
    element("tr", { class: "paper" }, element("th", { scope: "row" }, row.name),
      ...row.cells.map((text) => element("td", {}, text))));
  const heads = DATA.columns.map((column, i) => sortHead(column.header.join("\n"), i, quartileSort, drawQuartiles, column.share));
  byId("quartile-table").replaceChildren(
    element("thead", {}, element("tr", {}, element("th", { scope: "col" }, "estimate"), ...heads)),
    element("tbody", {}, ...body, ...paper));
}

function bestText(rows, i, share) {
  const known = rows.map((series) => series.cells[i]).filter(([, value]) => value !== null);
  if (rows.length < 2 || known.length === 0) return null;
  return known.reduce((best, other) => ((share ? other[1] > best[1] : other[1] < best[1]) ? other : best))[0];
}

// The head of a column that sorts when it is pressed, and the other way round when it is pressed again.
function sortHead(text, key, state, redraw, descendingFirst) {
  const sorted = state.column === key;
  const press = (event) => {
    const { id } = event.currentTarget.closest("table");
    state.descending = sorted ? !state.descending : descendingFirst;
    state.column = key;
    redraw();
    document.querySelector(`#${id} [data-key="${key}"]`).focus();
  };
  const order = state.descending ? "descending" : "ascending";
  return element("th", { scope: "col", "aria-sort": sorted ? order : null },
    element("button", { type: "button", "data-key": key, onclick: press }, text));
}

function swatch(series) {
  return shape("svg", { class: "swatch", "aria-hidden": "true", viewBox: "0 0 28 10" },
    shape("path", { d: "M0,5H28", style: `stroke: ${series.colour}; stroke-width: 3`, "stroke-dasharray": series.dashes }));
}

function drawSettings() {
  byId("settings").replaceChildren(...DATA.runs.flatMap((run) => {
    const { name, written, bpnp_version, correspondence_loss, settings } = run;
    const facts = { written, bpnp_version, correspondence_loss, settings };
    return [element("h3", {}, name), element("pre", { tabindex: 0 }, JSON.stringify(facts, null, 2))];
  }));
}
