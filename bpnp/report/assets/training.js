// The curves of the training, and why pairs fail.

const TRAINING = [
  { title: "Training loss", keys: ["train/loss", "train/correspondence_loss", "train/pose_loss"] },
  { title: "Validation: correspondence loss", keys: ["val/correspondence_loss"] },
  { title: "Validation: median rotation error, degrees", keys: ["val/rotation_q2_deg"], log: true },
];

function drawTraining() {
  if (DATA.logs.length === 0) {
    byId("training-charts").replaceChildren(element("p", { class: "note" }, "No training log beside these results."));
    return;
  }
  const panels = TRAINING.map((panel) => ({ ...panel, lines: DATA.logs.flatMap((log) => curvesOf(log, panel.keys)) }));
  drawCharts(byId("training-charts"), panels.filter(({ lines }) => lines.length).map(({ title, lines, log }) => {
    const [steps, values] = [0, 1].map((axis) => lines.flatMap(({ points }) => points.map((point) => point[axis])));
    const marks = DATA.logs.filter((run) => run.switch_step !== null).map((run) => ({
      x: run.switch_step, label: DATA.logs.length > 1 ? `${run.name}: pose loss` : "pose loss joins" }));
    const y = { label: title, domain: log ? decades(values) : padded(values), log };
    return { title, x: { label: "step", domain: [0, Math.max(1, ...steps)] }, y, lines, marks };
  }));
}

// Before the pose loss joins, the correspondence loss is the whole loss.
function curvesOf({ name, curves, switch_step }, keys) {
  const known = keys.filter((key, k) => key in curves && (k === 0 || switch_step !== null));
  const several = DATA.logs.length > 1;
  const own = SERIES.find(({ run }) => run.name === name).colour;
  return known.map((key) => {
    const [steps, values] = [column(curves[key].steps), column(curves[key].values)];
    const points = [...steps].map((step, j) => [step, values[j]]).filter(([, value]) => Number.isFinite(value));
    const short = key.split("/")[1].replaceAll("_", " ");
    return {
      name: several ? `${name} ${short}` : short,
      colour: several ? own : `var(--c${keys.indexOf(key)})`,
      dashes: ["", "6 3", "2 2"][keys.indexOf(key)],
      points,
    };
  }).filter(({ points }) => points.length);
}

const CAUSE_FILLS = ["var(--panel)", "var(--c5)", "var(--c7)", "var(--c1)", "var(--c0)", "var(--c3)"];

function drawFailures() {
  const rows = shownSeries().map((series) => {
    const shares = once(series, "causes", () => {
      const counts = new Array(DATA.causes.length).fill(0);
      for (const cause of series.get("cause")) counts[cause]++;
      return counts.map((count) => count / series.get("cause").length);
    });
    const bar = shares.map((share, i) => element("span", { style: `width: ${100 * share}%; --fill: ${CAUSE_FILLS[i]}` }));
    return element("tr", {}, element("th", { scope: "row" }, swatch(series), series.name),
      element("td", {}, element("div", { class: "bar", "aria-hidden": "true" }, ...bar)),
      ...shares.map((share) => element("td", {}, `${(100 * share).toFixed(1)}%`)));
  });
  const heads = DATA.causes.map((cause, i) =>
    element("th", { scope: "col", class: "cause" }, element("span", { class: "fill", style: `--fill: ${CAUSE_FILLS[i]}` }), ` ${cause}`));
  byId("cause-table").replaceChildren(
    element("thead", {}, element("tr", {}, element("th", { scope: "col" }, "estimate"), element("th", {}, ""), ...heads)),
    element("tbody", {}, ...rows));
  byId("cause-note").textContent = `Solved: rotation error up to ${DATA.solved_deg} degrees. Fits the image: half of the ` +
    "2D points have a reprojected 3D point beside them. Not converged: the solver itself says so.";
}
