// The list of pairs with its filters, the first of them as small pictures, and the points of a pair.

const [ROWS, PICTURES] = [25, 12];
const POINTS = JSON.parse(byId("points").textContent);
const text = (series, { key, whole }, i) => (whole ? String(series.get(key)[i]) : number(series.get(key)[i]));
const listed = () => SERIES[state.list] ?? SERIES[0];
const labelled = (id) => id || "(no name)";
let chosen = [];
let open = null;

for (const group of POINTS) {
  let [at2d, at3d] = [0, 0];
  const counts = column(group.counts);
  group.place = new Map(Array.from(column(group.rows), (row, k) => {
    const [m, n, matched] = counts.subarray(3 * k, 3 * k + 3);
    const start = { k, at2d, at3d, m, n, matched };
    [at2d, at3d] = [at2d + m, at3d + n];
    return [row, start];
  }));
}
const groupOf = (run, i) => POINTS.find((group) => run.name in group.poses && group.place.has(i));

function poseAt(packed, k) {
  const [x, y, z, w] = column(packed.rotation).subarray(4 * k, 4 * k + 4);
  const norm = x * x + y * y + z * z + w * w;
  const s = 2 / norm;
  return norm === 0 ? null : [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w), s * (x * y + z * w),
    1 - s * (x * x + z * z), s * (y * z - x * w), s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y),
    ...column(packed.translation).subarray(3 * k, 3 * k + 3)];
}

function viewOf(group, i) {
  const { k, at2d, at3d, m, n, matched } = group.place.get(i);
  const box = column(group.boxes).subarray(10 * k, 10 * k + 10);
  const points = (packed, at, count, width, low, size) => Array.from({ length: count }, (_, j) =>
    Array.from({ length: width }, (_, d) => low[d] + (column(packed)[(at + j) * width + d] / 65535) * size[d]));
  const poses = Object.entries(group.poses).flatMap(([run, own]) => Object.entries(own).map(([estimate, packed]) => ({
    series: SERIES.find(({ key }) => key === `${run}: ${estimate}`), pose: poseAt(packed, k) })));
  return { points2d: points(group.points2d, at2d, m, 2, box.subarray(0, 2), box.subarray(2, 4)),
    points3d: points(group.points3d, at3d, n, 3, box.subarray(4, 7), box.subarray(7, 10)),
    ids2d: column(group.ids2d).subarray(at2d, at2d + m), ids3d: column(group.ids3d).subarray(at3d, at3d + n),
    match3d: Array.from({ length: n }, (_, j) => (j < matched ? j : -1)), box, truth: poseAt(group.truth, k),
    cameras: poses.filter(({ pose }) => pose), assigned: (run) => group.assigned[run.name]?.[i] && column(group.assigned[run.name][i]) };
}

const toCamera = (pose, p) => [0, 1, 2].map((r) => pose[3 * r] * p[0] + pose[3 * r + 1] * p[1] + pose[3 * r + 2] * p[2] + pose[9 + r]);
const toScene = (pose, c) => [0, 1, 2].map((d) => [0, 1, 2].reduce((sum, r) => sum + pose[3 * r + d] * (c[r] - pose[9 + r]), 0));
const projected = (pose, p) => { const [x, y, z] = toCamera(pose, p); return z > 0 ? [x / z, y / z] : null; };

// Positions of the pairs that pass the filters, sorted; undefined errors last.
function selectPairs() {
  const series = listed();
  const [cause, status, error] = ["cause", "status", "rotation_error_deg"].map(series.get);
  const wanted = state.name.toLowerCase();
  const found = [...series.ids.keys()].filter((i) => (!wanted || series.ids[i].toLowerCase().includes(wanted)) &&
    (state.cause === "" || cause[i] === Number(state.cause)) && (state.status === "" || status[i] === Number(state.status)) &&
    error[i] >= Number(state.least) && (!state.drawn || groupOf(series.run, i)));
  const sign = state.up ? 1 : -1;
  if (state.sort === "id") return found.sort((a, b) => sign * series.ids[a].localeCompare(series.ids[b]));
  const values = series.get(DATA.columns.some(({ key }) => key === state.sort) ? state.sort : DEFAULTS.sort);
  const order = (a, b) => (values[a] === values[b] ? 0 : sign * (values[a] < values[b] ? -1 : 1));
  return found.sort((a, b) => Number.isNaN(values[a]) - Number.isNaN(values[b]) || order(a, b) || a - b);
}

function pairRow(series, i, head) {
  const cause = series.get("cause")[i];
  return element("tr", {}, element("th", { scope: "row" }, head),
    ...DATA.columns.map((shape) => element("td", {}, text(series, shape, i))),
    element("td", { class: "words" }, element("span", { class: `fill cause${cause}` }), ` ${DATA.causes[cause]}`));
}

function drawPairs() {
  const series = listed();
  chosen = selectPairs();
  const pages = Math.max(1, Math.ceil(chosen.length / ROWS));
  const page = Math.min(Number(state.page), pages - 1);
  for (const { dataset, parentNode } of document.querySelectorAll("#pair-table [data-key]"))
    parentNode.setAttribute("aria-sort", dataset.key !== state.sort ? "none" : state.up ? "ascending" : "descending");
  byId("pair-table").tBodies[0].replaceChildren(...chosen.slice(page * ROWS, (page + 1) * ROWS).map((i) => pairRow(series, i,
    element("button", { type: "button", class: "link", onclick: () => openPair(i) }, `${groupOf(series.run, i) ? "◉ " : ""}${labelled(series.ids[i])}`))));
  byId("page-back").disabled = page === 0;
  byId("page-on").disabled = page === pages - 1;
  byId("page").textContent = `${page + 1} / ${pages} · ${chosen.length} of ${series.ids.length} pairs`;
  const kept = series.ids.reduce((sum, _, i) => sum + (groupOf(series.run, i) ? 1 : 0), 0);
  byId("kept").textContent = `◉: points in this page, of ${kept === series.ids.length ? "all" : kept} of the ${series.ids.length} pairs; ` +
    "24 a side, of the worst pairs and some others up to 300. ← and → go through the list while a pair is open.";
  byId("gallery").replaceChildren(...chosen.filter((i) => groupOf(series.run, i)).slice(0, PICTURES).map((i) => thumbnail(series, i)));
}

// Image points as circles, 3D points reprojected by the listed estimate as crosses.
function thumbnail(series, i) {
  const view = viewOf(groupOf(series.run, i), i);
  const sparse = (points) => points.filter((_, k) => k % Math.ceil(points.length / 40) === 0);
  const [x, y, width, height] = view.box;
  const unit = Math.max(width, height, 1e-9) / 100;
  const pose = view.cameras.find((camera) => camera.series === series)?.pose;
  const photo = DATA.photos[series.ids[i]];
  const crosses = !pose ? "" : sparse(view.points3d).map((p) => projected(pose, p)).filter(Boolean)
    .map(([u, v]) => `M${u - 2 * unit},${v - 2 * unit}l${4 * unit},${4 * unit}m0,${-4 * unit}l${-4 * unit},${4 * unit}`).join("");
  const [l, t, r, b] = photo?.box ?? [];
  return element("button", { type: "button", onclick: () => openPair(i) },
    element("svg", { viewBox: `${x - 8 * unit} ${y - 8 * unit} ${width + 16 * unit} ${height + 16 * unit}`, "aria-hidden": "true" },
      ...(photo ? [element("image", { href: `data:image/jpeg;base64,${photo.jpeg}`, x: l, y: t, width: r - l, height: b - t })] : []),
      ...sparse(view.points2d).map(([cx, cy]) => element("circle", { cx, cy, r: 2 * unit, stroke: photo ? "#ffffff" : ink("text"), "stroke-width": unit / 2 })),
      element("path", { d: crosses, stroke: ink(`c${series.index}`), "stroke-width": unit })),
    `${number(series.get("rotation_error_deg")[i])} deg, ${series.ids[i]}`);
}
