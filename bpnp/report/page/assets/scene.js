// The two views of a pair, in space and in the image; a click picks a point in both.

function drawPair() {
  if (!byId("pair").open || !open?.view) return;
  const { view, poses } = open;
  const camera = poses[byId("pose").value];
  const assigned = (camera?.series ?? open.series) && view.assigned((camera?.series ?? open.series).run);
  byId("lines").querySelector("[value=assigned3d]").disabled = !assigned;
  if (!assigned && byId("lines").value === "assigned3d") byId("lines").value = "match3d";
  open.targets = byId("lines").value === "assigned3d" ? assigned : byId("lines").value ? view.match3d : view.match3d.map(() => -1);
  byId("picked").textContent = "Click a point to see its number and its partner.";
  drawScene(view, poses);
  drawImage(view, camera);
  for (const id of ["scene", "image"]) {
    byId(id).removeAllListeners("plotly_click");
    byId(id).on("plotly_click", pickIn);
  }
}

function drawScene(view, poses) {
  // In the axes of the true camera: right, forward, up.
  const frame = poses[0]?.pose ?? [1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0];
  const upright = (p) => { const [x, y, z] = toCamera(frame, p); return [x, z, -y]; };
  const points = view.points3d.map(upright);
  const middle = [0, 1, 2].map((d) => points.map((p) => p[d]).sort((a, b) => a - b)[points.length >> 1]);
  const size = Math.hypot(...[0, 1, 2].map((d) => Math.max(...points.map((p) => p[d])) - Math.min(...points.map((p) => p[d]))));
  const depth = Math.max(0.3 * Math.hypot(...middle), 1e-9);
  const [left, top, width, height] = view.box;
  const corners = [[0, 0, 0], ...[[0, 0], [1, 0], [1, 1], [0, 1]].map(([u, v]) => [(left + u * width) * depth, (top + v * height) * depth, depth])];
  const far = [];
  const cameras = poses.filter(({ series }) => !series || shown(series)).flatMap(({ name, pose, series }) => {
    const own = corners.map((corner) => upright(toScene(pose, corner)));
    if (Math.hypot(...own[0].map((v, d) => v - middle[d])) > 12 * depth + 2 * size) { far.push(name); return []; }
    const path = [0, 1, 2, 0, 3, 4, 0, 2, 3, 4, 1].map((k) => own[k]);
    return [{ type: "scatter3d", mode: "lines", ...xyz(path), name, hovertemplate: `${name.replace(/[<%]/g, " ")}<extra></extra>`,
      line: { color: series ? colour(series) : css("--text"), width: series ? 4 : 7 } }];
  });
  const label = view.points3d.map((_, j) => `3D point ${view.ids3d[j]}${view.match3d[j] < 0 ? ", no match" : `, 2D point ${view.ids2d[view.match3d[j]]}`}`);
  const marks = { size: 3.5, color: view.match3d.map((j) => css(j < 0 ? "--quiet" : "--focus")), line: { width: 0 } };
  const axis = { gridcolor: css("--line"), zerolinecolor: css("--line"), color: css("--quiet"), backgroundcolor: "rgba(0,0,0,0)", showspikes: false };
  const named = (title) => ({ ...axis, title: { text: title } });
  open.points = points;
  Plotly.react("scene", [{ type: "scatter3d", mode: "markers", ...xyz(points), marker: marks, text: label, hovertemplate: "%{text}<extra></extra>" },
    { type: "scatter3d", mode: "markers", ...xyz([]), marker: { size: 9, color: css("--wrong"), symbol: "circle-open" }, hoverinfo: "skip" }, ...cameras],
    theme({ margin: { l: 0, r: 0, t: 0, b: 0 }, uirevision: open.id, hovermode: "closest", scene: { aspectmode: "data", dragmode: "orbit",
      xaxis: named("right"), yaxis: named("forward"), zaxis: named("up"), camera: { eye: { x: 0.9, y: -1.5, z: 0.7 } } } }), CONFIG);
  const what = `${points.length} 3D points (${view.match3d.filter((j) => j >= 0).length} with a true match) and the cameras of ` +
    `${cameras.map(({ name }) => name).join(", ") || "no pose"}${far.length ? `; too far away to draw: ${far.join(", ")}` : ""}`;
  byId("scene-text").textContent = `${what}. Drag to turn, scroll to zoom.`;
  byId("scene").setAttribute("aria-label", what);
}

const xyz = (points) => Object.fromEntries(["x", "y", "z"].map((name, d) => [name, points.map((p) => p[d])]));

function drawImage(view, camera) {
  const photo = byId("photo").checked ? DATA.photos[open.id] : undefined;
  const ends = camera ? view.points3d.map((p) => projected(camera.pose, p)) : view.points3d.map(() => null);
  const ink = photo ? "#ffffff" : css("--text");
  const own = camera?.series ? colour(camera.series) : css("--focus");
  const lines = (right) => view.points3d.flatMap((_, j) => {
    const i = open.targets[j];
    const same = open.targets === view.match3d || view.match3d[j] === i;
    return i >= 0 && ends[j] && same === right ? [view.points2d[i], ends[j], [null, null]] : [];
  });
  const xy = (points) => ({ x: points.map((p) => p?.[0] ?? null), y: points.map((p) => p?.[1] ?? null) });
  const line = (points, style) => ({ ...xy(points), mode: "lines", hoverinfo: "skip", line: { width: 1.2, ...style } });
  const [left, top, width, height] = view.box;
  const rim = 0.15;
  const many = view.points2d.length > 100;
  open.ends = ends;
  Plotly.react("image", [line(lines(true), { color: photo ? "#ffffff" : css("--quiet") }), line(lines(false), { color: css("--wrong"), dash: "dot" }),
    { ...xy(view.points2d), mode: "markers", marker: { symbol: "circle-open", size: many ? 6 : 9, color: ink, line: { width: 1.6 } },
      text: view.points2d.map((_, i) => `2D point ${view.ids2d[i]}`), hovertemplate: "%{text}<extra></extra>" },
    { ...xy(ends), mode: "markers", marker: { symbol: "x-thin", size: many ? 4 : 7, color: own, line: { width: many ? 1.2 : 2, color: own } },
      text: view.points3d.map((_, j) => `3D point ${view.ids3d[j]}`), hovertemplate: "%{text}<extra></extra>" },
    { x: [], y: [], mode: "markers", marker: { symbol: "circle-open", size: 16, color: css("--wrong"), line: { width: 2 } }, hoverinfo: "skip" }],
    theme({ margin: { l: 40, r: 10, t: 10, b: 30 }, hovermode: "closest", uirevision: open.id, dragmode: "pan", images: photo ? [{
      source: `data:image/jpeg;base64,${photo.jpeg}`, xref: "x", yref: "y", x: photo.box[0], y: photo.box[1], xanchor: "left", yanchor: "top",
      sizex: photo.box[2] - photo.box[0], sizey: photo.box[3] - photo.box[1], sizing: "stretch", layer: "below" }] : [],
      xaxis: { range: [left - rim * width, left + (1 + rim) * width], constrain: "domain", zeroline: false },
      yaxis: { range: [top + (1 + rim) * height, top - rim * height], scaleanchor: "x", constrain: "domain", zeroline: false } }),
    { ...CONFIG, scrollZoom: true });
  const inside = ends.filter((p) => p && p[0] >= left - rim * width && p[0] <= left + (1 + rim) * width && p[1] >= top - rim * height && p[1] <= top + (1 + rim) * height);
  const what = `○ ${view.points2d.length} image points, × ${inside.length} of ${ends.length} 3D points reprojected by ${camera?.name ?? "no pose"}; the others lie outside or behind the camera`;
  byId("image-text").textContent = `${what}. Dotted lines are wrong matches.`;
  byId("image").setAttribute("aria-label", what);
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
    const angle = Math.atan2(Math.hypot(...cross), a[0] * b[0] + a[1] * b[1] + 1);
    words.push(`reprojection error ${number((angle * 180) / Math.PI)} deg`);
  }
  byId("picked").textContent = words.join(" · ") + (i < 0 || j < 0 ? " · no partner" : "");
  const marks = [i >= 0 ? view.points2d[i] : null, j >= 0 ? ends[j] : null].filter(Boolean);
  Plotly.restyle("image", { x: [marks.map((p) => p[0])], y: [marks.map((p) => p[1])] }, [4]);
  const spot = xyz(j >= 0 ? [open.points[j]] : []);
  Plotly.restyle("scene", { x: [spot.x], y: [spot.y], z: [spot.z] }, [1]);
}

function pickIn(event) {
  const [{ curveNumber, pointNumber, data }] = event.points;
  const of3d = data.type === "scatter3d" ? curveNumber === 0 : curveNumber === 3;
  if (of3d) pick(open.targets[pointNumber], pointNumber);
  else if (data.type !== "scatter3d" && curveNumber === 2) pick(pointNumber, Array.from(open.targets).indexOf(pointNumber));
}

async function start() {
  const stream = new Blob([bytes(byId("plotly").textContent)]).stream().pipeThrough(new DecompressionStream("gzip"));
  document.head.append(element("script", {}, await new Response(stream).text()));
  byId("list").append(...SERIES.map((series, i) => element("option", { value: i }, series.name)));
  byId("cause").append(...DATA.causes.map((cause, i) => element("option", { value: i }, cause)));
  byId("status").append(...DATA.statuses.map((status, i) => element("option", { value: i }, status)));
  for (const id of ["a", "b"]) byId(id)?.append(...SERIES.map((series, i) => element("option", { value: i }, series.name)));
  for (const input of document.querySelectorAll("[data-state]")) {
    if (input.type === "checkbox") input.checked = Boolean(state[input.id]);
    else input.value = state[input.id];
    input.addEventListener("input", () => {
      setState({ [input.id]: input.type === "checkbox" ? (input.checked ? "1" : "") : input.value, page: "0" });
      if (["a", "b"].includes(input.id)) drawComparison();
      else drawPairs();
    });
  }
  document.querySelectorAll("#series button").forEach((button) => button.addEventListener("click", () => {
    const hidden = new Set(state.hidden.split(" ").filter(Boolean));
    if (!hidden.delete(button.dataset.series)) hidden.add(button.dataset.series);
    setState({ hidden: [...hidden].join(" ") });
    drawSeries();
  }));
  document.querySelectorAll("nav a").forEach((link) => link.addEventListener("click", (event) => {
    event.preventDefault();
    document.querySelector(link.hash).scrollIntoView();
  }));
  document.querySelectorAll("th button.sort").forEach((button) => button.addEventListener("click", () => sortTable(button)));
  for (const id of ["pose", "lines", "photo"]) byId(id).addEventListener("input", drawPair);
  byId("previous").addEventListener("click", () => step(-1));
  byId("next").addEventListener("click", () => step(1));
  byId("close").addEventListener("click", () => byId("pair").close());
  byId("pair").addEventListener("close", () => setState({ pair: "" }));
  byId("pair").addEventListener("keydown", ({ key, target }) => {
    if (!target.matches("select, input") && ["ArrowLeft", "ArrowRight"].includes(key)) step(key === "ArrowLeft" ? -1 : 1);
  });
  const draw = (node) => (node.id === "versus" ? drawComparison() : drawChart(node));
  const watcher = new IntersectionObserver((entries) => entries.filter((entry) => entry.isIntersecting).forEach(({ target }) => {
    watcher.unobserve(target);
    draw(target);
    if (target.id === "versus") target.on("plotly_click", ({ points: [point] }) => { byId("list").value = state.a; setState({ list: state.a }); drawPairs(); openPair(point.customdata); });
  }), { rootMargin: "300px" });
  document.querySelectorAll(".chart").forEach((node) => watcher.observe(node));
  addEventListener("beforeprint", () => document.querySelectorAll(".chart").forEach(draw));
  dark.addEventListener("change", () => { drawSeries(); drawComparison(); if (SERIES.length) drawPairs(); drawPair(); });
  drawSeries();
  byId("pairs").hidden = !SERIES.length;
  if (SERIES.length) drawPairs();
  const i = (listed()?.ids ?? []).findIndex((id) => (wellFormed(id) || "(no name)") === state.pair);
  if (state.pair && i >= 0) openPair(i);
  document.documentElement.dataset.ready = "1";
}
start();
