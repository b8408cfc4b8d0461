// One pair: its numbers in every run that has it, and its points where a run kept them.

let open = null;

function openPair(i) {
  const series = listedSeries();
  // Runs on the same pairs share their list of names; in others the name is looked for.
  const place = (other) => (other.ids === series.ids ? i : other.ids.indexOf(series.ids[i]));
  open = { position: i, id: series.ids[i], place };
  byId("pair-title").textContent = open.id || "(no name)";
  drawNumbers();
  const all = [series, ...SERIES];
  const kept = all.find((other) => place(other) in other.run.views) ?? all.find((other) => hasPoints(other.run, place(other)));
  byId("pair-views").hidden = kept === undefined;
  byId("pair-missing").hidden = kept !== undefined;
  const rank = listed.indexOf(i);
  byId("pair-previous").disabled = rank <= 0;
  byId("pair-next").disabled = rank < 0 || rank === listed.length - 1;
  if (!byId("pair").open) byId("pair").showModal();
  history.replaceState(null, "", `#pair=${encodeURIComponent(wellFormed(open.id))}`);
  if (kept === undefined) return;
  const own = kept.run.views[place(kept)];
  open.view = own ? unpackedView(own) : sketchedView(kept.run, place(kept));
  byId("pair-lines").querySelector("[value=assigned3d]").disabled = !own;
  if (!own && byId("pair-lines").value === "assigned3d") byId("pair-lines").value = "match3d";
  loadPhoto(open);
  open.cameras = camerasOf(open.view, kept.run);
  const wanted = open.cameras.findIndex(({ name }) => name === series.estimate);
  byId("pair-estimate").replaceChildren(...open.cameras.map(({ name }, k) => element("option", { value: k }, name)));
  byId("pair-estimate").value = String(Math.max(wanted, 0));
  redrawViews();
}

function drawNumbers() {
  const rows = SERIES.map((series) => [series, open.place(series)]).filter(([, i]) => i >= 0);
  const body = rows.map(([series, i]) =>
    element("tr", {}, element("th", { scope: "row" }, swatch(series), series.name),
      ...PAIR_COLUMNS.map(([key]) => element("td", {}, pairText(key, pairColumn(series, key)[i]))),
      element("td", { class: "words" }, DATA.causes[series.get("cause")[i]])));
  const heads = PAIR_COLUMNS.map(([, text]) => element("th", { scope: "col" }, text));
  byId("pair-numbers").replaceChildren(
    element("thead", {}, element("tr", {}, element("th", { scope: "col" }, "estimate"), ...heads,
      element("th", { scope: "col", class: "words" }, "cause"))),
    element("tbody", {}, ...body));
}

function unpackedView(view) {
  const points = (packed) => {
    const { low, size } = packed;
    const steps = column(packed);
    return Array.from({ length: steps.length / low.length }, (_, i) =>
      low.map((start, k) => start + (steps[i * low.length + k] / 65535) * size[k]));
  };
  return {
    points2d: points(view.points2d),
    points3d: points(view.points3d),
    box2d: view.points2d,
    match3d: column(view.match3d),
    assigned3d: column(view.assigned3d),
    pose: view.pose,
    estimates: view.estimates,
  };
}

function camerasOf(view, run) {
  const estimates = Object.entries(view.estimates).filter(([, pose]) => pose !== null).map(([name, pose]) => {
    const { colour, dashes } = SERIES.find((series) => series.run === run && series.estimate === name) ?? { colour: "var(--c0)", dashes: "" };
    return { name, pose, colour, dashes: dashes.split(" ").filter(Boolean).map(Number) };
  });
  return view.pose === null ? estimates : [{ name: "true pose", pose: view.pose, colour: "var(--text)", upright: true }, ...estimates];
}

function redrawViews() {
  if (!byId("pair").open || !open?.view || byId("pair-views").hidden) return;
  const camera = open.cameras[byId("pair-estimate").value];
  drawScene(open.view, open.cameras);
  if (camera) drawImage(open.view, camera, byId("pair-lines").value, byId("pair-photo").checked ? open.photo : null);
}

function prepareDialog() {
  const step = (by) => () => openPair(listed[listed.indexOf(open.position) + by]);
  byId("pair-previous").addEventListener("click", step(-1));
  byId("pair-next").addEventListener("click", step(1));
  byId("pair-close").addEventListener("click", () => byId("pair").close());
  byId("pair").addEventListener("close", () => history.replaceState(null, "", location.pathname + location.search));
  for (const id of ["pair-estimate", "pair-lines", "pair-photo"]) byId(id).addEventListener("input", redrawViews);
}

// The undistorted photo of a pair, where the page has one; drawn again when it is decoded.
function loadPhoto(pair) {
  const kept = Object.hasOwn(DATA.photos, pair.id) ? DATA.photos[pair.id] : null;
  byId("pair-photo-label").hidden = kept === null;
  pair.photo = null;
  if (kept === null) return;
  const image = new Image();
  image.addEventListener("load", () => {
    pair.photo = { image, box: kept.box };
    if (pair === open) redrawViews();
  });
  image.src = `data:image/jpeg;base64,${kept.jpeg}`;
}

// Names that are not UTF-8 hold lone surrogates, which addresses cannot.
const wellFormed = (text) => text.replace(/\p{Surrogate}/gu, "\ufffd");

// A link to report.html#pair=ID opens that pair.
function openFromAddress() {
  if (!location.hash.startsWith("#pair=")) return;
  const id = decodeURIComponent(location.hash.slice("#pair=".length));
  const i = SERIES.findIndex((series) => series.ids.some((own) => wellFormed(own) === id));
  if (i < 0) return;
  byId("pair-series").value = String(i);
  drawPairs();
  openPair(SERIES[i].ids.findIndex((own) => wellFormed(own) === id));
}
