// Line charts in SVG, redrawn at the width they have.

const MARGIN = { left: 46, right: 10, top: 8, bottom: 34 };
const HEIGHT = 240;

function scale({ domain, log }, from, to) {
  const place = log ? Math.log10 : (value) => value;
  const [low, high] = domain.map(place);
  const scaled = (value) => {
    const clamped = Math.min(Math.max(value, domain[0]), domain[1]);
    return from + ((place(clamped) - low) / (high - low || 1)) * (to - from);
  };
  scaled.inverse = (pixel) => {
    const value = low + ((pixel - from) / (to - from)) * (high - low);
    return log ? 10 ** value : value;
  };
  return scaled;
}

function ticks({ domain: [low, high], log }, most) {
  const values = [];
  if (log) {
    const decades = Math.log10(high / low);
    const steps = decades > 2.5 ? [1] : [1, 2, 5];
    const stride = Math.ceil(decades / most);
    for (let power = Math.floor(Math.log10(low)); power <= Math.log10(high); power += stride) {
      values.push(...steps.map((step) => step * 10 ** power));
    }
  } else {
    const rough = (high - low) / most || 1;
    const power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].find((factor) => factor * power >= rough) * power;
    for (let i = Math.ceil(low / step); i * step <= high * (1 + 1e-9); i++) values.push(i * step);
  }
  return values.filter((value) => value >= low * (1 - 1e-9) && value <= high * (1 + 1e-9));
}

// chart: {title, x, y: {label, domain, log, format}, lines: [{name, colour, dashes, points, spread}], marks: [{x, label}]}.
// points are [x, y] in ascending x; spread, where given, [low, high] of each.
function drawCharts(place, charts) {
  const figures = charts.map((chart) => {
    const picture = shape("svg", { class: "chart", role: "img", tabindex: 0, "aria-label": described(chart) });
    const readout = element("p", { class: "readout", "aria-live": "polite" });
    return { chart, picture, readout, figure: element("figure", {}, element("figcaption", {}, chart.title), picture, readout) };
  });
  // All are in place before the first is drawn, since they share the width.
  place.replaceChildren(...figures.map(({ figure }) => figure));
  for (const { chart, picture, readout } of figures) drawChart(picture, readout, chart);
}

function drawChart(picture, readout, chart) {
  const width = Math.max(picture.clientWidth, 200);
  const x = scale(chart.x, MARGIN.left, width - MARGIN.right);
  const y = scale(chart.y, HEIGHT - MARGIN.bottom, MARGIN.top);
  const bottom = HEIGHT - MARGIN.bottom;
  for (const value of ticks(chart.x, 5)) {
    picture.append(
      shape("line", { class: "grid", x1: x(value), x2: x(value), y1: MARGIN.top, y2: bottom }),
      shape("text", { x: x(value), y: bottom + 14, "text-anchor": "middle" }, label(value, chart.x)),
    );
  }
  for (const value of ticks(chart.y, 5)) {
    picture.append(
      shape("line", { class: "grid", x1: MARGIN.left, x2: width - MARGIN.right, y1: y(value), y2: y(value) }),
      shape("text", { x: MARGIN.left - 5, y: y(value) + 4, "text-anchor": "end" }, label(value, chart.y)),
    );
  }
  const middle = (MARGIN.left + width - MARGIN.right) / 2;
  picture.append(
    shape("text", { x: middle, y: HEIGHT - 4, "text-anchor": "middle" }, chart.x.label),
    shape("path", { class: "frame", d: `M${MARGIN.left},${MARGIN.top}V${bottom}H${width - MARGIN.right}` }),
  );
  for (const line of chart.lines) drawLine(picture, line, x, y);
  for (const [row, mark] of (chart.marks ?? []).entries()) {
    const right = x(mark.x) > middle;
    picture.append(
      shape("line", { class: "mark", x1: x(mark.x), x2: x(mark.x), y1: MARGIN.top, y2: bottom }),
      shape("text", { class: "mark-text", x: x(mark.x) + (right ? -4 : 4), y: MARGIN.top + 11 + 12 * row,
        "text-anchor": right ? "end" : "start" }, mark.label),
    );
  }
  const cursor = shape("line", { class: "cursor", y1: MARGIN.top, y2: bottom });
  picture.append(cursor);
  followCursor(picture, cursor, readout, chart, x);
}

function drawLine(picture, line, x, y) {
  if (line.points.length === 0) return;
  const style = `stroke: ${line.colour}`;
  const path = line.points.map(([a, b], i) => `${i ? "L" : "M"}${x(a).toFixed(1)},${y(b).toFixed(1)}`).join("");
  (line.spread ?? []).forEach(([low, high], i) => {
    const at = x(line.points[i][0]);
    picture.append(shape("line", { class: "spread", style, x1: at, x2: at, y1: y(low), y2: y(high) }));
  });
  picture.append(shape("path", { class: "series", style, d: path, "stroke-dasharray": line.dashes }));
  if (line.points.length <= 20) {
    for (const [a, b] of line.points) picture.append(shape("circle", { cx: x(a), cy: y(b), r: 3, style: `fill: ${line.colour}` }));
  }
}

// The values under the pointer; the arrow keys move it too.
function followCursor(picture, cursor, readout, chart, x) {
  let at = null;
  const show = (value) => {
    at = Math.min(Math.max(value, chart.x.domain[0]), chart.x.domain[1]);
    filled(cursor, { x1: x(at), x2: x(at), style: "visibility: visible" }, []);
    const parts = chart.lines.filter((line) => line.points.length).map((line) => `${line.name} ${label(nearest(line.points, at)[1], chart.y)}`);
    readout.textContent = `${label(at, chart.x)}: ${parts.join(" · ")}`;
  };
  const hide = () => {
    cursor.style.visibility = "hidden";
    readout.textContent = "";
  };
  picture.addEventListener("pointermove", (event) => show(x.inverse(event.offsetX)));
  picture.addEventListener("pointerleave", hide);
  picture.addEventListener("blur", hide);
  picture.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 10, ArrowLeft: -10 }[event.key];
    if (step === undefined) return;
    event.preventDefault();
    show(at === null ? chart.x.domain[0] : x.inverse(x(at) + step));
  });
}

function nearest(points, at) {
  return points.reduce((best, point) => (Math.abs(point[0] - at) < Math.abs(best[0] - at) ? point : best));
}

function label(value, axis) {
  if (axis.percent) return `${Number((100 * value).toFixed(1))}%`;
  return String(Number(value.toPrecision(3)));
}

function described({ title, x, y, lines }) {
  const ends = lines.filter((line) => line.points.length).map((line) => `${line.name} ends at ${label(line.points.at(-1)[1], y)}`);
  return `${title}. ${y.label ?? ""} against ${x.label}. ${ends.join(", ")}. Arrow keys read values.`;
}
