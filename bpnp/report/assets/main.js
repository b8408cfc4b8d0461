// What is drawn when.

function drawAll() {
  for (const draw of [drawQuartiles, drawRecall, drawErrors, drawTime, drawTraining, drawFailures]) draw();
}

function prepareSeries() {
  byId("series").append(...SERIES.map((series) => {
    const press = (event) => {
      series.shown = !series.shown;
      event.currentTarget.setAttribute("aria-pressed", series.shown);
      drawAll();
    };
    return element("button", { type: "button", "aria-pressed": "true", onclick: press }, swatch(series), series.name);
  }));
}

function describePage() {
  const counts = [...new Set(DATA.runs.map((run) => DATA.ids[run.ids].length))].sort((a, b) => a - b);
  const names = DATA.runs.map(({ name }) => name);
  byId("about").textContent = `${names.join(", ")} · ${counts.join(" or ")} pairs`;
}

describePage();
prepareSeries();
preparePairs();
prepareScene();
prepareDialog();
byId("log-thresholds").addEventListener("input", drawRecall);
drawSettings();
drawAll();
drawPairs();
openFromAddress();

let width = document.documentElement.clientWidth;
window.addEventListener("resize", () => {
  // Phones resize the height when their bars hide; nothing drawn depends on it.
  if (width === document.documentElement.clientWidth) return;
  width = document.documentElement.clientWidth;
  drawAll();
  redrawViews();
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redrawViews);
