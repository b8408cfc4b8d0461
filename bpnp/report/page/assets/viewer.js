// One pair with the cameras of all runs, in space and in the image; a click picks a point in both. Then the start.

function openPair(i) {
  const series = listed();
  open = { i, id: series.ids[i], series, at: (other) => (other.ids === series.ids ? i : other.ids.indexOf(series.ids[i])) };
  setState({ pair: wellFormed(labelled(open.id)) });
  byId("pair-title").textContent = labelled(open.id);
  byId("pair-numbers").tBodies[0].replaceChildren(
    ...SERIES.filter((other) => open.at(other) >= 0).map((other) => pairRow(other, open.at(other), other.name)));
  const rank = chosen.indexOf(i);
  byId("previous").disabled = rank <= 0;
  byId("next").disabled = rank < 0 || rank === chosen.length - 1;
  const owner = [series, ...SERIES].find((other) => open.at(other) >= 0 && groupOf(other.run, open.at(other)));
  byId("views").hidden = !owner;
  byId("missing").hidden = Boolean(owner);
  if (!byId("pair").open) byId("pair").showModal();
  if (!owner) return;
  open.view = viewOf(groupOf(owner.run, open.at(owner)), open.at(owner));
  open.poses = [...(open.view.truth ? [{ name: "true pose", pose: open.view.truth }] : []),
    ...open.view.cameras.map(({ series: own, pose }) => ({ name: own.name, pose, series: own }))];
  byId("pose").replaceChildren(...open.poses.map(({ name }, k) => element("option", { value: k }, name)));
  byId("pose").value = String(Math.max(0, open.poses.findIndex((camera) => camera.series === series)));
  byId("photo-label").hidden = !(open.id in DATA.photos);
  drawPair();
}

function step(by) {
  const next = chosen[chosen.indexOf(open.i) + by];
  if (next !== undefined && byId("pair").open) openPair(next);
}

function drawPair() {
  if (!byId("pair").open || !open?.view) return;
  const { view, poses, series } = open;
  const camera = poses[byId("pose").value];
  const assigned = view.assigned((camera?.series ?? series).run);
  byId("lines").querySelector("[value=assigned3d]").disabled = !assigned;
  if (!assigned && byId("lines").value === "assigned3d") byId("lines").value = "match3d";
  open.targets = { match3d: view.match3d, assigned3d: assigned }[byId("lines").value] ?? view.match3d.map(() => -1);
  byId("picked").textContent = "Click a point to see its number and its partner.";
  drawScene(view, poses);
  drawImage(view, camera);
  for (const id of ["scene", "image"]) {
    byId(id).removeAllListeners("plotly_click");
    byId(id).on("plotly_click", pickIn);
  }
}

const xyz = (points) => Object.fromEntries(["x", "y", "z"].map((name, d) => [name, points.map((p) => p?.[d] ?? null)]));
const xy = (points) => ({ x: points.map((p) => p?.[0] ?? null), y: points.map((p) => p?.[1] ?? null) });

function say(id, what, more) {
  byId(`${id}-text`).textContent = what + more;
  byId(id).setAttribute("aria-label", what);
}

function drawScene(view, poses) {
  // In the axes of the true camera: right, forward, up.
  const frame = poses[0]?.pose ?? [1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0];
  const upright = (p) => { const [x, y, z] = toCamera(frame, p); return [x, z, -y]; };
  const points = open.points = view.points3d.map(upright);
  const sorted = [0, 1, 2].map((d) => points.map((p) => p[d]).sort((a, b) => a - b));
  const middle = sorted.map((values) => values[values.length >> 1]);
  const size = Math.hypot(...sorted.map((values) => values.at(-1) - values[0]));
  const depth = Math.max(0.3 * Math.hypot(...middle), 1e-9);
  const [left, top, width, height] = view.box;
  const corners = [[0, 0, 0], ...[[0, 0], [1, 0], [1, 1], [0, 1]].map(([u, v]) => [(left + u * width) * depth, (top + v * height) * depth, depth])];
  const cameras = poses.filter(({ series }) => !series || shown(series)).map((camera) =>
    ({ ...camera, own: corners.map((corner) => upright(toScene(camera.pose, corner))) }));
  const isFar = ({ own }) => Math.hypot(...own[0].map((v, d) => v - middle[d])) > 12 * depth + 2 * size;
  const [near, far] = [cameras.filter((camera) => !isFar(camera)), cameras.filter(isFar)].map((some) => some.map((camera) => camera.name));
  const figure = themed(DATA.figures.scene);
  figure.layout.uirevision = open.id;
  Object.assign(figure.data[0], xyz(points), { text: view.match3d.map((i, j) =>
    `3D point ${view.ids3d[j]}${i < 0 ? ", no match" : `, 2D point ${view.ids2d[i]}`}`) });
  figure.data[0].marker.color = view.match3d.map((i) => ink(i < 0 ? "line" : "quiet"));
  for (const { name, series, own } of cameras.filter((camera) => !isFar(camera)))
    figure.data.push({ type: "scatter3d", mode: "lines", ...xyz([0, 1, 2, 0, 3, 4, 0, 2, 3, 4, 1].map((k) => own[k])), name,
      hovertemplate: `${name.replace(/[<%]/g, " ")}<extra></extra>`, line: { color: ink(series ? `c${series.index}` : "text"), width: series ? 4 : 7 } });
  draw("scene", figure);
  say("scene", `${points.length} 3D points (${view.match3d.filter((i) => i >= 0).length} with a true match) and the cameras of ` +
    `${near.join(", ") || "no pose"}${far.length ? `; too far away to draw: ${far.join(", ")}` : ""}`, ". Drag to turn, scroll to zoom.");
}

function drawImage(view, camera) {
  const photo = byId("photo").checked ? DATA.photos[open.id] : undefined;
  const ends = open.ends = view.points3d.map((p) => camera && projected(camera.pose, p));
  const lines = (right) => xy(view.points3d.flatMap((_, j) => {
    const i = open.targets[j];
    const same = open.targets === view.match3d || view.match3d[j] === i;
    return i >= 0 && ends[j] && same === right ? [view.points2d[i], ends[j], null] : [];
  }));
  const [left, top, width, height] = view.box;
  const [rim, small] = [0.15, view.points2d.length > 100 ? 0.6 : 1];
  const range = [[left - rim * width, left + (1 + rim) * width], [top + (1 + rim) * height, top - rim * height]];
  const { data, layout } = themed(DATA.figures.image);
  data.forEach((trace, k) => Object.assign(trace, [lines(true), lines(false), xy(view.points2d), xy(ends), { x: [], y: [] }][k]));
  if (photo) data[0].line.color = "#ffffff";
  Object.assign(data[2], { text: Array.from(view.ids2d, (id) => `2D point ${id}`) }).marker = { ...data[2].marker, size: 9 * small, color: photo ? "#ffffff" : ink("text") };
  const own = ink(camera?.series ? `c${camera.series.index}` : "focus");
  Object.assign(data[3], { text: Array.from(view.ids3d, (id) => `3D point ${id}`) }).marker = { ...data[3].marker, size: 7 * small, color: own, line: { width: 2 * small, color: own } };
  layout.uirevision = open.id;
  [layout.xaxis, layout.yaxis].forEach((axis, d) => Object.assign(axis, { range: range[d], showgrid: !photo }));
  layout.images = !photo ? [] : [{ source: `data:image/jpeg;base64,${photo.jpeg}`, xref: "x", yref: "y", x: photo.box[0], y: photo.box[1],
    sizex: photo.box[2] - photo.box[0], sizey: photo.box[3] - photo.box[1], sizing: "stretch", layer: "below" }];
  draw("image", { data, layout }, { scrollZoom: true });
  const inside = ends.filter((p) => p && p[0] >= range[0][0] && p[0] <= range[0][1] && p[1] >= range[1][1] && p[1] <= range[1][0]);
  say("image", `○ ${view.points2d.length} image points, × ${inside.length} of ${ends.length} 3D points reprojected by ` +
    `${camera?.name ?? "no pose"}${inside.length < ends.length ? "; the others lie outside or behind the camera" : ""}`, ". Dotted lines are wrong matches.");
}

// Point j of space and point i of the image, -1 for none.
function pick(i, j) {
  const { view, ends } = open;
  const words = [];
  if (j >= 0) words.push(`3D point ${view.ids3d[j]} at (${view.points3d[j].map(number).join(", ")})`);
  if (i >= 0) words.push(`2D point ${view.ids2d[i]} at (${view.points2d[i].map(number).join(", ")})`);
  if (i >= 0 && j >= 0 && ends[j]) {
    const [a, b] = [[...view.points2d[i], 1], [...ends[j], 1]];
    const cross = [a[1] - b[1], b[0] - a[0], a[0] * b[1] - a[1] * b[0]];
    words.push(`reprojection error ${number((Math.atan2(Math.hypot(...cross), a[0] * b[0] + a[1] * b[1] + 1) * 180) / Math.PI)} deg`);
  }
  byId("picked").textContent = words.join(" · ") + (i < 0 || j < 0 ? " · no partner" : "");
  const marks = xy([i >= 0 ? view.points2d[i] : null, j >= 0 ? ends[j] : null].filter(Boolean));
  Plotly.restyle("image", { x: [marks.x], y: [marks.y] }, [4]);
  const spot = xyz(j >= 0 ? [open.points[j]] : []);
  Plotly.restyle("scene", { x: [spot.x], y: [spot.y], z: [spot.z] }, [1]);
}

function pickIn({ points: [{ curveNumber, pointNumber, data }] }) {
  const of3d = data.type === "scatter3d" ? curveNumber === 0 : curveNumber === 3;
  if (of3d) pick(open.targets[pointNumber], pointNumber);
  else if (data.type !== "scatter3d" && curveNumber === 2) pick(pointNumber, Array.from(open.targets).indexOf(pointNumber));
}

const on = (target, kind, act) => target.addEventListener(kind, act);
const each = (selector, act) => document.querySelectorAll(selector).forEach(act);

async function start() {
  const stream = new Blob([bytes(byId("plotly").textContent)]).stream().pipeThrough(new DecompressionStream("gzip"));
  document.head.append(element("script", {}, await new Response(stream).text()));
  each("[data-state]", (input) => {
    const own = input.type === "checkbox" ? "checked" : "value";
    input[own] = state[input.id];
    on(input, "input", () => {
      setState({ [input.id]: own === "value" ? input.value : input.checked ? "1" : "", page: "0" });
      (["a", "b"].includes(input.id) ? drawComparison : drawPairs)();
    });
  });
  each("#series button", (button) => on(button, "click", () => {
    const hidden = new Set(state.hidden.split(" ").filter(Boolean));
    if (!hidden.delete(button.dataset.series)) hidden.add(button.dataset.series);
    setState({ hidden: [...hidden].join(" ") });
    drawSeries();
  }));
  each("nav a", (link) => on(link, "click", (event) => { event.preventDefault(); document.querySelector(link.hash).scrollIntoView(); }));
  each("#quartile-table [data-key]", (button) => on(button, "click", () => sortTable(button)));
  each("#pair-table [data-key]", ({ dataset: { key } }, k, all) => on(all[k], "click", () => {
    setState({ up: state.sort === key && !state.up ? "1" : "", sort: key, page: "0" });
    drawPairs();
  }));
  for (const id of ["page-back", "page-on"]) on(byId(id), "click", () => { setState({ page: String(Number(state.page) + (id === "page-on" ? 1 : -1)) }); drawPairs(); });
  for (const id of ["pose", "lines", "photo"]) on(byId(id), "input", drawPair);
  for (const [id, by] of [["previous", -1], ["next", 1]]) on(byId(id), "click", () => step(by));
  on(byId("close"), "click", () => byId("pair").close());
  on(byId("pair"), "close", () => setState({ pair: "" }));
  on(byId("pair"), "keydown", ({ key, target }) => {
    if (!target.matches("select, input") && ["ArrowLeft", "ArrowRight"].includes(key)) step(key === "ArrowLeft" ? -1 : 1);
  });
  const drawNode = (node) => (node.id === "versus" ? drawComparison() : drawChart(node));
  const watcher = new IntersectionObserver((entries) => entries.filter((entry) => entry.isIntersecting).forEach(({ target }) => {
    watcher.unobserve(target);
    drawNode(target);
    if (target.id === "versus") target.on("plotly_click", ({ points: [point] }) => {
      byId("list").value = state.a;
      setState({ list: state.a });
      drawPairs();
      openPair(point.customdata);
    });
  }), { rootMargin: "300px" });
  each(".chart", (node) => watcher.observe(node));
  on(window, "beforeprint", () => each(".chart", drawNode));
  on(dark, "change", drawSeries);
  document.documentElement.dataset.ready = "1";
  drawSeries();
  if (!SERIES.length) return;
  on(dark, "change", () => { drawComparison(); drawPairs(); drawPair(); });
  drawPairs();
  const i = listed().ids.findIndex((id) => wellFormed(labelled(id)) === state.pair);
  if (state.pair && i >= 0) openPair(i);
}
start();
