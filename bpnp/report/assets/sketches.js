// A few points of every pair, unpacked when a pair is opened. Their text is the larger part of the page.

const SKETCHES = JSON.parse(byId("sketches").textContent);
const sketchPlaces = new Map();

function sketchPlace(run, i) {
  const own = SKETCHES.runs[run.name];
  if (!own) return undefined;
  if (!sketchPlaces.has(own.group)) {
    const rows = column(SKETCHES.groups[own.group].rows);
    sketchPlaces.set(own.group, new Map(Array.from(rows, (row, place) => [row, place])));
  }
  return sketchPlaces.get(own.group).get(i);
}

const hasPoints = (run, i) => i in run.views || sketchPlace(run, i) !== undefined;

function sketchedPose(packed, k) {
  const [x, y, z, w] = column(packed.rotation).subarray(4 * k, 4 * k + 4);
  const norm = x * x + y * y + z * z + w * w;
  if (norm === 0) return null;
  const s = 2 / norm;
  return [
    1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w),
    s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w),
    s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y),
    ...column(packed.translation).subarray(3 * k, 3 * k + 3),
  ];
}

function sketchedView(run, i) {
  const own = SKETCHES.runs[run.name];
  const group = SKETCHES.groups[own.group];
  const k = sketchPlace(run, i);
  const [count2d, count3d, matched] = column(group.counts).subarray(3 * k, 3 * k + 3);
  const box = column(group.boxes).subarray(10 * k, 10 * k + 10);
  const points = (packed, dimension, count, low, size) => Array.from({ length: count }, (_, j) =>
    Array.from({ length: dimension }, (_, d) =>
      low[d] + (column(packed)[(k * group.points + j) * dimension + d] / 255) * size[d]));
  const [low2d, size2d, low3d, size3d] = [box.slice(0, 2), box.slice(2, 4), box.slice(4, 7), box.slice(7, 10)];
  return {
    points2d: points(group.points2d, 2, count2d, low2d, size2d),
    points3d: points(group.points3d, 3, count3d, low3d, size3d),
    box2d: { low: low2d, size: size2d },
    match3d: Array.from({ length: count3d }, (_, j) => (j < matched ? j : -1)),
    assigned3d: new Array(count3d).fill(-1),
    pose: sketchedPose(group.truth, k),
    estimates: Object.fromEntries(Object.entries(own.poses).map(([name, poses]) => [name, sketchedPose(poses, k)])),
  };
}
