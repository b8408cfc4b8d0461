// What the camera saw, circles, and what a pose says it should have seen, crosses, with lines between matches.

function drawImage(view, { name, pose, colour }, lines, photo) {
  const canvas = byId("image");
  const { pen, width, height } = fitted(canvas);
  const { low, size } = view.box2d;
  const zoom = Math.min(width / (size[0] || 1e-9), height / (size[1] || 1e-9)) / 1.3;
  const place = ([x, y]) => [width / 2 + (x - low[0] - size[0] / 2) * zoom, height / 2 + (y - low[1] - size[1] / 2) * zoom];
  if (photo) {
    const [[left, top], [right, bottom]] = [place(photo.box.slice(0, 2)), place(photo.box.slice(2))];
    pen.globalAlpha = 0.75;
    pen.drawImage(photo.image, left, top, right - left, bottom - top);
    pen.globalAlpha = 1;
  }
  const seen = view.points2d.map(place);
  const projected = view.points3d.map((point) => {
    const [x, y, z] = toCamera(pose, point);
    return z > 0 ? place([x / z, y / z]) : null;
  });
  const inside = (point) => point !== null && point[0] >= 0 && point[0] <= width && point[1] >= 0 && point[1] <= height;
  const matches = lines ? view[lines] : [];
  pen.lineWidth = 1;
  matches.forEach((i, j) => {
    if (i < 0 || projected[j] === null) return;
    const right = lines === "match3d" || view.match3d[j] === i;
    pen.strokeStyle = resolved(right ? "--quiet" : "--c3");
    pen.setLineDash(right ? [] : [3, 3]);
    stroke(pen, [seen[i], projected[j]]);
  });
  pen.setLineDash([]);
  const circles = () => {
    for (const [x, y] of seen) {
      pen.beginPath();
      pen.arc(x, y, 3, 0, 2 * Math.PI);
      pen.stroke();
    }
  };
  const crosses = () => {
    for (const [x, y] of projected.filter(inside)) {
      stroke(pen, [[x - 3, y - 3], [x + 3, y + 3]]);
      stroke(pen, [[x - 3, y + 3], [x + 3, y - 3]]);
    }
  };
  // Over a photo of any brightness every mark has a rim of the other brightness.
  const rimmed = (draw, colour, width) => {
    for (const [style, own] of photo ? [[resolved("--background"), width + 2], [colour, width]] : [[colour, width]]) {
      [pen.strokeStyle, pen.lineWidth] = [style, own];
      draw();
    }
  };
  rimmed(circles, resolved("--text"), 1);
  rimmed(crosses, resolved(colour), 1.5);
  const outside = projected.length - projected.filter(inside).length;
  canvas.setAttribute("aria-label", `Image points and 3D points reprojected by the pose ${name}`);
  byId("image-text").replaceChildren(`○ ${seen.length} of the image points, `,
    element("span", { class: "key", style: `color: ${colour}` }, `× 3D points reprojected by ${name}`),
    outside ? `, ${outside} outside or behind the camera` : "",
    lines === "assigned3d" ? "; dashed lines are wrong matches" : "");
}

function stroke(pen, [from, to]) {
  pen.beginPath();
  pen.moveTo(...from);
  pen.lineTo(...to);
  pen.stroke();
}
