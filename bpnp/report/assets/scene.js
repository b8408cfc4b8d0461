// Points and cameras in 3D on a canvas: drag, pinch, wheel or arrow keys turn and zoom.

const turning = { yaw: 0.7, pitch: 0.45, zoom: 1, draw: () => {} };

// A pose is twelve numbers, R by rows and t: camera = R p + t.
function toCamera(pose, [x, y, z]) {
  return [0, 1, 2].map((i) => pose[3 * i] * x + pose[3 * i + 1] * y + pose[3 * i + 2] * z + pose[9 + i]);
}

function toWorld(pose, point) {
  const [x, y, z] = point.map((value, i) => value - pose[9 + i]);
  return [0, 1, 2].map((i) => pose[i] * x + pose[3 + i] * y + pose[6 + i] * z);
}

// Image coordinates of the corners of what the 2D points span, for the frustum.
function frustum(pose, view, depth) {
  const { low, size } = view.box2d;
  const corners = [[0, 0], [1, 0], [1, 1], [0, 1]].map(([a, b]) => [low[0] + a * size[0], low[1] + b * size[1], 1]);
  return [toWorld(pose, [0, 0, 0]), ...corners.map((corner) => toWorld(pose, corner.map((value) => value * depth)))];
}

function fitted(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  [canvas.width, canvas.height] = [width * ratio, height * ratio];
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  return { pen, width, height };
}

const resolved = (colour) => getComputedStyle(document.documentElement).getPropertyValue(colour.replace(/var\((.*)\)/, "$1")).trim();

// The scene in the axes of the true camera (or of the scene, if that is unknown), about its middle.
function drawScene(view, cameras) {
  const canvas = byId("scene");
  const frame = cameras.find((camera) => camera.upright)?.pose ?? cameras[0]?.pose ?? [1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0];
  const points = view.points3d.map((point) => toCamera(frame, point));
  const middle = [0, 1, 2].map((i) => median(points.map((point) => point[i])));
  const radius = quantile(points.map((point) => distance(point, middle)).sort((a, b) => a - b), 0.9) || 1;
  const range = Math.max(radius, distance(middle, [0, 0, 0]));
  const near = (point) => distance(toCamera(frame, point), middle) < 3 * range;
  const drawn = cameras.filter((camera) => near(toWorld(camera.pose, [0, 0, 0])));
  const shapes = drawn.map((camera) => ({ ...camera, corners: frustum(camera.pose, view, 0.5 * range).map((point) => toCamera(frame, point)) }));
  const all = [...points.filter((point) => distance(point, middle) < 2 * radius), ...shapes.flatMap(({ corners }) => corners)];
  const pivot = [0, 1, 2].map((i) => (Math.min(...all.map((point) => point[i])) + Math.max(...all.map((point) => point[i]))) / 2);
  const reach = Math.max(radius, ...all.map((point) => distance(point, pivot)));
  turning.draw = () => {
    const { pen, width, height } = fitted(canvas);
    const place = (point) => {
      const [x, y, z] = turned(point.map((value, i) => value - pivot[i]));
      const size = (0.5 * Math.min(width, height) * turning.zoom) / reach;
      const depth = 1 + (0.25 * z) / reach;
      return [width / 2 + (x * size) / depth, height / 2 + (y * size) / depth];
    };
    pen.fillStyle = resolved("--quiet");
    for (const point of points) {
      const [x, y] = place(point);
      pen.fillRect(x - 1.2, y - 1.2, 2.4, 2.4);
    }
    const taken = [];
    for (const { corners, ...camera } of shapes) drawCamera(pen, corners.map(place), camera, taken);
  };
  turning.draw();
  const absent = cameras.filter((camera) => !drawn.includes(camera)).map(({ name }) => name);
  canvas.setAttribute("aria-label", `3D points and cameras: ${drawn.map(({ name }) => name).join(", ")}`);
  byId("scene-text").replaceChildren(`${points.length} of the 3D points; `, ...keyed(drawn),
    absent.length ? `; too far away to show: ${absent.join(", ")}` : "", ". Drag or arrow keys turn, wheel or + and − zoom.");
}

// taken: the boxes [left, right, y] of the names drawn so far, which this one evades downwards.
// Dashes are those of the estimate's curves; the true camera, drawn first, is wider: where they agree both are seen.
function drawCamera(pen, [centre, ...corners], { colour, dashes = [], name, upright }, taken) {
  pen.strokeStyle = pen.fillStyle = resolved(colour);
  pen.lineWidth = upright ? 3.5 : 1.8;
  pen.setLineDash(dashes);
  pen.beginPath();
  corners.forEach((corner, i) => {
    pen.moveTo(...centre);
    pen.lineTo(...corner);
    pen.lineTo(...corners[(i + 1) % 4]);
  });
  pen.stroke();
  pen.setLineDash([]);
  pen.font = "12px system-ui, sans-serif";
  // The name stands behind the camera, out of its way.
  const back = centre.map((value, i) => value - corners.reduce((sum, corner) => sum + corner[i], 0) / 4);
  const size = Math.hypot(...back) || 1;
  const half = pen.measureText(name).width / 2;
  const wanted = centre[0] + ((12 + half) * back[0]) / size - half;
  const x = Math.min(Math.max(wanted, 2), pen.canvas.clientWidth - 2 * half - 2);
  let y = centre[1] + (14 * back[1]) / size + 4;
  const over = () => taken.find(([left, right, other]) => left < x + 2 * half + 4 && x < right + 4 && Math.abs(other - y) < 13);
  for (let hit = over(); hit; hit = over()) y = hit[2] + 13;
  taken.push([x, x + 2 * half, y]);
  pen.fillText(name, x, y);
}

function turned([x, y, z]) {
  const [c, s, d, e] = [Math.cos(turning.yaw), Math.sin(turning.yaw), Math.cos(turning.pitch), Math.sin(turning.pitch)];
  const [a, b] = [c * x + s * z, -s * x + c * z];
  return [a, d * y - e * b, e * y + d * b];
}

const distance = (a, b) => Math.hypot(...a.map((value, i) => value - b[i]));
const median = (values) => quantile([...values].sort((a, b) => a - b), 0.5);
const keyed = (cameras) => cameras.flatMap(({ name, colour }, i) => [i ? ", " : "", element("span", { class: "key", style: `color: ${colour}` }, name)]);

function turn(yaw, pitch, zoom = 1) {
  turning.yaw += yaw;
  turning.pitch = Math.min(Math.max(turning.pitch + pitch, -1.5), 1.5);
  turning.zoom = Math.min(Math.max(turning.zoom * zoom, 0.2), 20);
  turning.draw();
}

function prepareScene() {
  const canvas = byId("scene");
  const held = new Map();
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, [event.offsetX, event.offsetY]);
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => held.delete(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    const before = held.get(event.pointerId);
    if (before === undefined) return;
    const now = [event.offsetX, event.offsetY];
    const other = [...held].find(([id]) => id !== event.pointerId)?.[1];
    if (other) turn(0, 0, distance(now, other) / (distance(before, other) || 1));
    else turn((before[0] - now[0]) / 120, (now[1] - before[1]) / 120);
    held.set(event.pointerId, now);
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    turn(0, 0, Math.exp(-event.deltaY / 500));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const keys = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1], "+": [0, 0, 1.15], "-": [0, 0, 1 / 1.15] };
    if (!(event.key in keys)) return;
    event.preventDefault();
    turn(...keys[event.key]);
  });
}
