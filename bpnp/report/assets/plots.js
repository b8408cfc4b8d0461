// Recall, errors against what makes a pair hard, and time.

const PERCENT = { label: "pairs", domain: [0, 1], percent: true };
const RECALLS = [
  { title: "Rotation", key: "rotation_error_deg", label: "rotation error, degrees", linear: 20, log: [0.01, 180] },
  { title: "Translation", key: "translation_error", label: "translation error, scene units", linear: 1, log: [0.001, 10] },
  { title: "Rotation, translation within 0.5", key: "rotation_error_deg", joint: 0.5,
    label: "rotation error, degrees", linear: 20, log: [0.01, 180] },
  { title: "Reprojection", key: "reprojection_error_deg", label: "reprojection error, degrees", linear: 2, log: [0.01, 180] },
];
const POINTS = 160;
const GROUPS = 8;

// What is worked out from the columns of a series, and kept.
function once(series, key, make) {
  series.kept ??= new Map();
  if (!series.kept.has(key)) series.kept.set(key, make());
  return series.kept.get(key);
}

const sortedColumn = (series, key) => once(series, key, () => series.get(key).filter((value) => !Number.isNaN(value)).sort());

// Errors in ascending order, and the number of pairs that they are a share of.
function recallOf(series, { key, joint }) {
  if (joint === undefined) return { errors: sortedColumn(series, key), all: sortedColumn(series, key).length };
  const translation = series.get("translation_error");
  const errors = once(series, `joint ${joint}`, () => series.get(key).filter((_, i) => translation[i] <= joint).sort());
  return { errors, all: translation.length };
}

function drawRecall() {
  const log = byId("log-thresholds").checked;
  drawCharts(byId("recall-charts"), RECALLS.map((panel) => {
    const domain = log ? panel.log : [0, panel.linear];
    const x = { label: panel.label, domain, log };
    const at = scale(x, 0, 1).inverse;
    const limits = Array.from({ length: POINTS + 1 }, (_, i) => at(i / POINTS));
    const lines = shownSeries().map((series) => {
      const { errors, all } = recallOf(series, panel);
      return line(series, all ? limits.map((limit) => [limit, countUpTo(errors, limit) / all]) : []);
    });
    return { title: panel.title, x, y: PERCENT, lines };
  }));
}

const line = ({ name, colour, dashes }, points, spread) => ({ name, colour, dashes, points, spread });

const HARDNESS = [
  { title: "Number of 3D points", label: "3D points", of: (series) => series.size("n") },
  { title: "Outliers", label: "share of points without a true match", of: (series) => {
    const [m, n, pairs] = ["m", "n", "true_pairs"].map(series.size);
    return Float32Array.from(pairs, (count, i) => 1 - (2 * count) / (m[i] + n[i]));
  } },
  { title: "Inliers of the estimate", label: "share of 2D points with a 3D point beside them", of: (series) => {
    const m = series.size("m");
    return Float32Array.from(series.get("inliers"), (count, i) => count / m[i]);
  } },
];

function drawErrors() {
  const shown = shownSeries();
  drawCharts(byId("error-charts"), HARDNESS.map(({ title, label, of }) => {
    const lines = shown.map((series) => {
      const groups = once(series, title, () => grouped(of(series), series.get("rotation_error_deg")));
      const spread = shown.length <= 4 ? groups.map((group) => [group.low, group.high]) : undefined;
      return line(series, groups.map((group) => [group.x, group.median]), spread);
    });
    const xs = lines.flatMap(({ points }) => points.map(([x]) => x));
    const ys = lines.flatMap(({ points, spread }) => [...points.map(([, y]) => y), ...(spread ?? []).flat()]);
    const counted = title === "Number of 3D points";
    const x = { label, domain: counted ? padded(xs) : [0, Math.max(0.2, ...xs)], log: counted && Math.max(...xs) > 8 * Math.min(...xs) };
    const [low, high] = decades(ys);
    return { title, x, y: { label: "degrees", domain: [low, Math.min(high, 180)], log: true }, lines };
  }));
}

// Quartiles of the errors in groups of equal size and ascending x; pairs of one x are never parted.
function grouped(x, errors) {
  const order = Uint32Array.from(x.keys()).sort((a, b) => x[a] - x[b]);
  const size = Math.ceil(order.length / GROUPS);
  const groups = [];
  for (let start = 0; start < order.length; ) {
    let end = Math.min(start + size, order.length);
    while (end < order.length && x[order[end]] === x[order[end - 1]]) end++;
    const members = order.subarray(start, end);
    const sorted = Float32Array.from(members, (i) => errors[i]).sort();
    const [low, median, high] = [0.25, 0.5, 0.75].map((share) => quantile(sorted, share));
    groups.push({ x: x[members[members.length >> 1]], low, median, high });
    start = end;
  }
  return groups;
}

function padded(values) {
  const [low, high] = [Math.min(...values), Math.max(...values)];
  return low < high ? [low, high] : [0.5 * low, 1.5 * high + 1e-9];
}

// A range of whole powers of ten around the positive, finite values.
function decades(values) {
  const known = values.filter((value) => value > 0 && value < Infinity);
  if (known.length === 0) return [0.1, 10];
  const [low, high] = [Math.floor(Math.log10(Math.min(...known))), Math.ceil(Math.log10(Math.max(...known)))];
  return [10 ** Math.max(low, high - 8), 10 ** Math.max(high, low + 1)];
}

// The estimates of a run are made together: one time for all.
function drawTime() {
  const runs = shownSeries().filter((series, i, all) => all.findIndex(({ run }) => run === series.run) === i);
  const named = (series, points) => ({ ...line(series, points), name: series.run.name, dashes: "" });
  const times = runs.map((series) => sortedColumn(series, "seconds"));
  const x = { label: "seconds per pair", domain: decades(times.flatMap((seconds) => [seconds[0], seconds.at(-1)])), log: true };
  const at = scale(x, 0, 1).inverse;
  const limits = Array.from({ length: POINTS + 1 }, (_, i) => at(i / POINTS));
  const within = runs.map((series, i) =>
    named(series, limits.map((limit) => [limit, countUpTo(times[i], limit) / times[i].length])));
  const sums = runs.map((series) => named(series, once(series, "cumulative time", () => cumulative(series.get("seconds")))));
  const ends = sums.map(({ points }) => points.at(-1));
  drawCharts(byId("time-charts"), [
    { title: "Pairs done within a time", x, y: PERCENT, lines: within },
    {
      title: "Cumulative run time, in the order of the data set",
      x: { label: "pairs", domain: [0, Math.max(1, ...ends.map(([pairs]) => pairs))] },
      y: { label: "seconds", domain: [0, Math.max(1e-9, ...ends.map(([, seconds]) => seconds))] },
      lines: sums,
    },
  ]);
}

function cumulative(seconds) {
  const points = [[0, 0]];
  const stride = Math.ceil(seconds.length / POINTS);
  let sum = 0;
  seconds.forEach((value, i) => {
    sum += value;
    if ((i + 1) % stride === 0 || i === seconds.length - 1) points.push([i + 1, sum]);
  });
  return points;
}
