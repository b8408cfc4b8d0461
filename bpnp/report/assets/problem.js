// One problem with the cameras of all runs, in space and in the image; a click picks a point in both.

let open = {};
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
function turned([x, y, z, w], p) {
  const once = cross([x, y, z], p);
  return cross([x, y, z], once).map((twice, k) => p[k] + 2 * (w * once[k] + twice));
}
// A pose is a quaternion (x, y, z, w) and a translation: camera = R p + t.
const toCamera = (pose, p) => turned(pose, p).map((v, k) => v + pose[4 + k]);
const toScene = ([x, y, z, w, ...t], c) => turned([-x, -y, -z, w], c.map((v, k) => v - t[k]));
const projected = (pose, p) => { const [x, y, z] = toCamera(pose, p); return z > 0 ? [x / z, y / z] : null; };
const xyz = (points) => Object.fromEntries(["x", "y", "z"].map((name, d) => [name, points.map((p) => p?.[d] ?? null)]));
const extent = (points, d) => { const all = points.map((p) => p[d]); return [Math.min(...all), Math.max(...all)]; };

function drawnProblem(series, i) {
  const drawn = JSON.parse(LINES[series.lines[i]]);
  const [[left, right], [top, bottom]] = [extent(drawn.points2d, 0), extent(drawn.points2d, 1)];
  const cameras = [{ name: "true pose", colour: ink("text"), pose: drawn.truth }, ...SERIES.map((own, k) =>
    ({ name: own.name, series: own, k, colour: ink(own.colour), pose: drawn.poses[own.run]?.[own.estimate] }))];
  return { ...drawn, box: [left, top, right - left, bottom - top],
    cameras: cameras.filter(({ pose }) => pose) };
}

const swatch = (series) => byId(`series${SERIES.indexOf(series)}`).nextElementSibling.cloneNode(true);

function openProblem(i) {
  const series = listed();
  const at = (other) => (other.problems === series.problems ? i : other.problems.indexOf(series.problems[i]));
  setState({ open: series.ids[i] });
  byId("problem-title").textContent = series.ids[i];
  const runs = SERIES.filter((other) => at(other) >= 0);
  byId("problem-numbers").tBodies[0].replaceChildren(...runs.map((s) => problemRow(s, at(s), swatch(s), s.name)));
  const rank = chosen.indexOf(i);
  [byId("previous").disabled, byId("next").disabled] = [rank <= 0, rank < 0 || rank === chosen.length - 1];
  const owner = [series, ...runs].find((other) => other.lines[at(other)] >= 0);
  [byId("drawings").hidden, byId("missing").hidden] = [!owner, Boolean(owner)];
  if (!byId("problem").open) byId("problem").showModal();
  open = { i, series, drawn: owner && drawnProblem(owner, at(owner)) };
  if (!owner) return;
  byId("pose").replaceChildren(...open.drawn.cameras.map(({ name }, k) => element("option", { value: k }, name)));
  byId("pose").value = Math.max(0, open.drawn.cameras.findIndex((camera) => camera.series === series));
  drawProblem();
}

function step(by) {
  const next = chosen[chosen.indexOf(open.i) + by];
  if (next !== undefined) openProblem(next);
}

function drawProblem() {
  if (!byId("problem").open || !open.drawn) return;
  const { drawn, series } = open;
  const camera = drawn.cameras[byId("pose").value];
  const assigned = drawn.assigned[(camera?.series ?? series).run];
  byId("lines").querySelector("[value=assigned]").disabled = !assigned;
  if (!assigned && byId("lines").value === "assigned") byId("lines").value = "true";
  open.targets = { true: drawn.match3d, assigned }[byId("lines").value] ?? [];
  byId("picked").textContent = "Click a point to see its number and its match.";
  byId("photo-label").hidden = !drawn.photo;
  drawScene(drawn);
  open.ends = drawn.points3d.map((p) => camera && projected(camera.pose, p));
  draw(byId("image"), image(byId("photo").checked ? drawn : { ...drawn, photo: null }, camera, open.targets), { scrollZoom: true },
    ({ curveNumber, pointNumber }) => {
      if (curveNumber === 2) pick(pointNumber, open.targets.indexOf(pointNumber));
      if (curveNumber === 3) pick(open.targets[pointNumber] ?? -1, pointNumber);
    });
  const seen = open.ends.filter(Boolean).length;
  const hidden = camera && seen < drawn.points3d.length ? "; the others lie behind the camera" : "";
  say("image", `○ ${drawn.points2d.length} image points, × ${seen} of ${drawn.points3d.length} 3D points reprojected ` +
    `by ${camera?.name ?? "no pose"}${hidden}`, ". Dotted lines are wrong matches.");
  byId("image").show = drawProblem;
}

function say(id, what, more) {
  byId(`${id}-text`).textContent = what + more;
  byId(id).ariaLabel = what;
}

// In the axes of the first camera, the true one where it is known: right, forward, up.
function drawScene({ points3d, ids2d, ids3d, match3d, box: [left, top, width, height], cameras }) {
  const upright = (p) => { const [x, y, z] = cameras.length ? toCamera(cameras[0].pose, p) : p; return [x, z, -y]; };
  const points = open.points = points3d.map(upright);
  const middle = [0, 1, 2].map((d) => points.map((p) => p[d]).sort((a, b) => a - b)[points.length >> 1]);
  const depth = Math.max(0.3 * Math.hypot(...middle), 1e-9);
  const sizes = [0, 1, 2].map((d) => extent(points, d)).map(([low, high]) => high - low);
  const reach = 12 * depth + 2 * Math.hypot(...sizes);
  const corner = ([u, v]) => [left + u * width, top + v * height, 1].map((value) => value * depth);
  const corners = [[0, 0, 0], ...[[0, 0], [1, 0], [1, 1], [0, 1]].map(corner)];
  const figure = themed(DATA.figures.scene);
  const text = match3d.map((i, j) => `3D point ${ids3d[j]}${i < 0 ? ", no match" : `, 2D point ${ids2d[i]}`}`);
  Object.assign(figure.data[0], xyz(points), { text }).marker.color = match3d.map((i) => ink(i < 0 ? "line" : "quiet"));
  const { clientWidth, clientHeight } = byId("scene");
  const { eye } = figure.layout.scene.camera;  // from further away where the picture is narrow, as on a phone
  for (const axis of "xyz") eye[axis] *= Math.max(1, (1.3 * clientHeight) / clientWidth);
  const far = [];
  for (const { name, pose, colour, k } of cameras.filter((camera) => shown(camera.k))) {
    const own = corners.map((c) => upright(toScene(pose, c)));
    const outline = xyz([0, 1, 2, 0, 3, 4, 0, 2, 3, 4, 1].map((c) => own[c]));
    if (Math.hypot(...own[0].map((v, d) => v - middle[d])) > reach) far.push(name);
    else figure.data.push({ type: "scatter3d", mode: "lines", ...outline, name,
      hovertemplate: `${name.replace(/[<%]/g, " ")}<extra></extra>`, line: { color: colour, width: k === undefined ? 7 : 4 } });
  }
  draw(byId("scene"), { data: figure.data, layout: { ...figure.layout, uirevision: open.i } }, {}, ({ curveNumber, pointNumber }) => {
    if (curveNumber === 0) pick(open.targets[pointNumber] ?? -1, pointNumber);
  });
  const near = figure.data.slice(2).map(({ name }) => name).join(", ") || "no pose";
  const matched = match3d.filter((i) => i >= 0).length;
  say("scene", `${points.length} 3D points (${matched} with a true match) and the cameras of ${near}` +
    (far.length ? `; too far away to draw: ${far.join(", ")}` : ""), ". Drag to turn, scroll to zoom.");
  byId("scene").show = () => {};
}

// Image points, 3D points where a camera reprojects them, lines to their targets, dotted where these are wrong. The
// photo below them is pale, so that the colours of the points stay legible.
function image({ points2d, points3d, ids2d, ids3d, match3d, photo, box: [left, top, width, height] }, camera, targets) {
  const ends = points3d.map((p) => camera && projected(camera.pose, p));
  const lines = (right) => xyz(ends.flatMap((end, j) => (end && targets[j] >= 0 &&
    (targets === match3d || match3d[j] === targets[j]) === right ? [points2d[targets[j]], end, null] : [])));
  const { data, layout } = themed(DATA.figures.image);
  data.forEach((trace, k) => Object.assign(trace, [lines(true), lines(false), xyz(points2d), xyz(ends), {}][k]));
  const small = points2d.length > 100 ? 0.6 : 1;
  const marks = (k, name, ids, size, color) => Object.assign(data[k], { text: ids.map((id) => `${name} point ${id}`),
    marker: { ...data[k].marker, size: size * small, color, line: { width: 1.8 * small, color } } });
  marks(2, "2D", ids2d, 9, ink("text"));
  marks(3, "3D", ids3d, 7, camera?.colour ?? ink("focus"));
  if (photo) {
    const [x, y, right, bottom] = photo.extent;
    layout.images = [{ source: `data:image/jpeg;base64,${photo.jpeg}`, xref: "x", yref: "y", x, y, sizex: right - x,
      sizey: bottom - y, sizing: "stretch", layer: "below", opacity: 0.6 }];
  }
  Object.assign(layout.xaxis, { range: [left - 0.15 * width, left + 1.15 * width] });
  Object.assign(layout.yaxis, { range: [top + 1.15 * height, top - 0.15 * height] });
  return { data, layout: { ...layout, uirevision: open.i } };
}

function thumbnail(series, i) {
  const picture = element("div");
  watch(picture, () => {
    const drawn = drawnProblem(series, i);
    const { data, layout } = image(drawn, drawn.cameras.find((camera) => camera.series === series), []);
    layout.xaxis.visible = layout.yaxis.visible = false;
    draw(picture, { data, layout: { ...layout, margin: { l: 0, r: 0, t: 0, b: 0 } } }, { staticPlot: true });
  });
  const error = number(column(series, "rotation_error_deg")[i]);
  return element("button", { onclick: () => openProblem(i) }, picture, `${error} deg, ${series.ids[i]}`);
}

// Point j of space and point i of the image, -1 for none.
function pick(i, j) {
  const { drawn, ends } = open;
  const words = [];
  if (j >= 0) words.push(`3D point ${drawn.ids3d[j]} at (${drawn.points3d[j].map(number).join(", ")})`);
  if (i >= 0) words.push(`2D point ${drawn.ids2d[i]} at (${drawn.points2d[i].map(number).join(", ")})`);
  if (i >= 0 && j >= 0 && ends[j]) {
    const [a, b] = [[...drawn.points2d[i], 1], [...ends[j], 1]];
    const angle = Math.atan2(Math.hypot(...cross(a, b)), a[0] * b[0] + a[1] * b[1] + 1);
    words.push(`reprojection error ${number((angle * 180) / Math.PI)} deg`);
  }
  byId("picked").textContent = words.join(" · ") + (i < 0 || j < 0 ? " · no partner" : "");
  const spots = [xyz([drawn.points2d[i], ends[j]].filter(Boolean)), xyz([open.points[j]].filter(Boolean))];
  Plotly.restyle("image", { x: [spots[0].x], y: [spots[0].y] }, [4]);
  Plotly.restyle("scene", { x: [spots[1].x], y: [spots[1].y], z: [spots[1].z] }, [1]);
}

start();
