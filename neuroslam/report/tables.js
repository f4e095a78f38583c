"use strict";
// The text of the page: headline, sessions and merges, metrics, config, notes.

function startHeadline() {
  const s = about.summary, parts = [];
  if (s.frames) parts.push(many(s.frames, "frame"), duration(s.seconds), `${s.driven_m.toFixed(s.driven_m < 100 ? 1 : 0)} ${about.unit === "m" ? "m" : "(arbitrary unit)"} driven`);
  parts.push(many(s.places, "experience"), many(s.loop_closures, "loop closure"));
  if (about.sessions.length > 1) parts.push(many(about.sessions.length, "session"));
  if (about.merges.length) parts.push(many(about.merges.length, "merge"));
  if (s.ate_m !== null) parts.push(`ATE ${metres(s.ate_m)} (odometry alone ${metres(s.odometry_ate_m)})`);
  if (s.interrupted) parts.push("interrupted");
  $("headline").textContent = parts.join(" · ");
  $("headline").title = $("headline").textContent;
}

function tableOf(names, rows) {
  return make("div", { class: "scroll" }, make("table", {},
    make("thead", {}, make("tr", {}, ...names.map((text) => make("th", { text })))), make("tbody", {}, ...rows)));
}

const BEGAN = {
  start: "the run",
  kidnapped: "the robot was kidnapped",
  carried: "the robot was kidnapped", // brains of format 3
  gap: "a gap in the frames",
};

function startSessions() {
  const list = $("session-list"), places = new Array(about.sessions.length).fill(0);
  for (const session of run.place_session) places[session]++;
  list.append(make("div", { class: "card text" }, tableOf(["session", "source", "began with", "frames", "experiences", ""],
    about.sessions.map((session, i) => make("tr", {},
      make("td", {}, make("i", { class: "swatch", style: { background: sessionColour(i) } }), session.name),
      make("td", { text: [session.source || "unknown", session.preset && `preset ${session.preset}`, session.recorded].filter(Boolean).join(", ") }),
      make("td", { text: BEGAN[session.began] ?? session.began }),
      make("td", { text: `${session.frames.toLocaleString("en")} from ${session.first_frame}` }),
      make("td", { text: places[i].toLocaleString("en") }),
      make("td", { class: "soft", text: session.own ? "this run" : "stored map" }))))));
  const points = mergePoints();
  for (const report of about.merges) {
    const point = points.find((one) => (report.frame === null ? one.place === report.place : one.row === rowOfFrame(report.frame)));
    list.append(reportCard("Merged", report, point));
  }
  for (const report of about.refused) list.append(reportCard("Refused", report, null));
  for (const stored of about.not_joined) {
    list.append(make("div", { class: "card text" }, make("h3", { text: `Not joined: the map of ${stored.sessions.join(", ")}` }), make("p", { class: "soft", text: stored.reason })));
  }
  if (!about.merges.length && !about.refused.length && !about.not_joined.length) {
    list.append(make("p", { class: "lead", text: "One map without merges." }));
  }
  watch("colours", () => list.querySelectorAll("tbody .swatch").forEach((swatch, i) => { swatch.style.background = sessionColour(i); }));
}

function reportCard(outcome, report, point) {
  const [first, ...others] = report.lines;
  const heading = `${outcome}${report.frame === null ? "" : ` at frame ${report.frame}`}: ${first.replace(/^(not )?merged: /, "")}`;
  const card = make("div", { class: "card text" }, make("h3", { text: heading }),
    make("p", { class: "soft", text: `session ${report.partial.at(-1)} into ${report.loaded.join(", ")}` }),
    make("ul", {}, ...others.map((text) => make("li", { text }))));
  if (point) {
    card.append(make("button", { type: "button", text: "Show on the map", onclick: () => {
      if (point.row >= 0) chooseRow(point.row);
      choosePlace(point.place);
      $("explorer").scrollIntoView();
    } }));
  } else if (report.frame !== null && known.rows) {
    card.append(make("button", { type: "button", text: "Go to the frame", onclick: () => { chooseRow(rowOfFrame(report.frame)); $("explorer").scrollIntoView(); } }));
  }
  return card;
}

// Figures of `neuroslam plot`: the first is open, the others open at a click.
function startActivity() {
  const { note, figures } = about.activity;
  $("activity").hidden = $("to-activity").hidden = !figures.length;
  $("activity-note").textContent = note && `Activity ${note}.`;
  figures.forEach(({ title, webp, width, height }, i) => {
    const image = make("img", { class: "drawn", src: `data:image/webp;base64,${webp}`, width, height,
      alt: `${title}: rate maps, autocorrelograms and tuning curves, or activity over time` });
    const card = make("details", { class: "card text" }, make("summary", { text: title }), image);
    card.open = i === 0;
    $("activity-list").append(card);
  });
}

// Populations tell their counts and pictures themselves: the page need not know them.
function startPopulations() {
  $("populations").hidden = $("to-populations").hidden = !about.populations.length;
  for (const one of about.populations) {
    const card = make("div", { class: "card" }, make("h3", { text: one.kind }), make("p", { text: one.what }));
    if (one.counts.length) card.append(facts(one.counts.map(([name, value, unit]) => [name, `${figure(value)} ${unit}`.trim()])));
    for (const { tag, layers } of one.pictures) {
      const drawn = layers.map(({ png, width, height }) => {
        const scale = Math.max(1, Math.min(12, Math.floor(280 / Math.max(width, height))));
        return make("img", { class: "activity", src: `data:image/png;base64,${png}`,
          style: { width: `${width * scale}px`, height: `${height * Math.max(scale, Math.ceil(24 / height))}px` }, alt: `${tag}: activity of ${one.kind}` });
      });
      card.append(make("figure", {}, make("div", { class: "layers-of" }, ...drawn), make("figcaption", { text: tag })));
    }
    $("population-list").append(card);
  }
}

function figure(value) {
  if (typeof value === "boolean") return value ? "yes" : "no";
  if (typeof value !== "number") return String(value);
  return Number.isInteger(value) ? value.toLocaleString("en") : Number(value.toPrecision(4)).toString();
}

function startMetrics() {
  $("metric-list").append(make("div", { class: "figures" },
    ...about.metrics.map(([name, value, unit]) => make("div", {}, make("span", { class: "soft", text: name }), make("span", { text: `${figure(value)} ${unit}`.trim() })))));
  if (about.skipped.length) {
    $("metric-list").append(make("details", {}, make("summary", { text: `${many(about.skipped.length, "frame")} skipped` }),
      make("ul", {}, ...about.skipped.slice(0, 200).map((text) => make("li", { text })))));
  }
}

function startConfig() {
  const all = about.config.flatMap((part) => part.rows), differing = all.filter((row) => row.differs);
  const box = make("input", { type: "checkbox", id: "only" }), columns = make("div", { class: "config-columns only-differing" });
  box.checked = true;
  box.addEventListener("change", () => columns.classList.toggle("only-differing", box.checked));
  const { start, stop, on_bad_frame } = about.range;
  const folded = make("details", { open: innerWidth > 960 },
    make("summary", { text: `${differing.length} of ${all.length} parameters differ from ${about.base}` }),
    make("label", {}, box, " only parameters that differ"), columns);
  $("config-list").append(
    make("p", { class: "lead", text: `Frames ${start} to ${stop === null ? "the end" : stop - 1} of the source; bad frames: ${on_bad_frame}.` }), folded);
  for (const part of about.config) {
    const has = part.rows.some((row) => row.differs);
    columns.append(make("div", { class: `config-part${part.used ? "" : " unused"}${has ? " has-differing" : ""}` },
      make("h3", { text: part.section + (part.used ? "" : ", not in use") }),
      make("table", {}, make("tbody", {}, ...part.rows.map((row) => make("tr", { class: row.differs ? "differs" : "", title: row.what },
        make("td", { text: row.key }), make("td", { text: row.value }),
        make("td", { class: "soft", text: row.differs ? `${about.base === "the defaults" ? "default" : "preset"} ${row.default}` : "" })))))));
  }
}

function startNotes() {
  const keys = [["space", "play, pause"], ["← →", "one frame; with shift ten"], ["home end", "first and last frame"],
    ["on the map: arrows", "move"], ["+ −", "zoom"], ["0", "show all"], ["N P", "next and previous experience"], ["enter", "the experience nearest the middle"]];
  const notes = [
    "Experiences, links and the path are those of the final map: a frame keeps its offset from its experience, so the path moves with the map.",
    "The path follows the slider; experiences become opaque at their first visit. A loop closure is a link between experiences that both existed before it.",
    ...(run.row_truth_x_m ? [`The truth is aligned to the path by a similarity transform: one ${about.unit === "m" ? "metre" : about.unit} of the map is ${figure(about.truth_scale)} m. The errors among the metrics are without scaling.`] : []),
    ...about.notes, ...about.picture_notes,
    pictures.length ? `The page has ${many(pictures.length, "picture")} of frames; it shows the nearest one at or before the slider.` : "The page has no pictures of frames.",
    "The page is a single file and makes no network requests.",
  ];
  $("note-list").append(make("ul", {}, ...notes.map((text) => make("li", { text }))),
    make("p", {}, ...keys.flatMap(([key, what]) => [make("kbd", { text: key }), ` ${what}   `])));
}

function startLayers() {
  const there = { truth: !!run.row_truth_x_m, walls: !about.cells.includes("pose") && !!run.wall_x_m, landmarks: !!run.landmark_x_m && run.landmark_x_m.length > 0, plan: !!run.plan_place, merges: mergePoints().length > 0,
    odometry: known.rows > 0, whole: known.rows > 0, track: known.rows > 0, loops: known.loops.length > 0 };
  for (const [name, layer] of Object.entries(layers)) {
    if (there[name] === false) { layer.on = false; continue; }
    const box = make("input", { type: "checkbox", "data-layer": name });
    box.checked = layer.on;
    box.addEventListener("change", () => { layer.on = box.checked; map.forget(); map.draw(); showLegend(); });
    $("layers").append(make("label", {}, box, layer.name));
  }
  for (const [name, text] of Object.entries(colourings)) $("colouring").append(make("option", { value: name, text }));
  $("colouring").addEventListener("change", (event) => { map.colouring = event.target.value; map.bins = null; map.forget(); map.draw(); showLegend(); });
  watch("colours", showLegend);
}

function showLegend() {
  const items = [], add = (kind, style, text) => items.push(make("span", {}, make("i", { class: kind, style }), text));
  const colour = (value) => ({ borderColor: value });
  if (map.colouring === "session") {
    if (about.sessions.length < 2) add("key-dot", { background: sessionColour(0) }, !about.cells.includes("pose") ? "experiences (place cells)" : "experiences");
    else about.sessions.slice(0, 6).forEach((session, i) => add("key-dot", { background: sessionColour(i) }, `session ${i + 1}${session.own ? ", this run" : ""}`));
  } else add("key-ramp", { background: rampStyle }, `low to high: ${colourings[map.colouring]}`);
  if (layers.links.on) add("key-line", colour(colours.link), "links");
  if (layers.loops.on) add("key-line", colour(colours.loop), "loop closures");
  if (layers.track.on) add("key-line", colour(colours.path), "path up to the frame, the last seconds wide");
  if (layers.odometry.on) add("key-line", colour(colours.odometry), "odometry alone");
  if (layers.truth.on) add("key-line dashed", colour(colours.truth), Math.abs(about.truth_scale - 1) < 0.02 ? "truth" : `truth, scaled by ${(1 / about.truth_scale).toFixed(2)}`);
  if (layers.plan.on) add("key-line", { borderColor: colours.plan, borderTopWidth: "4px" }, "planned path");
  if (layers.merges.on) add("key-ring", colour(colours.match), "merge points");
  if (layers.walls.on) add("key-line", { borderColor: colours.wall, borderTopWidth: "3px" }, "remembered walls");
  if (layers.landmarks.on) add("key-dot", { background: colours.landmark }, "landmarks");
  const legend = $("legend"), { width, height } = legend.getBoundingClientRect();
  legend.replaceChildren(...items);
  // A layer switched off shortens the legend: without this the map would jump.
  legend.style.minHeight = legend.keptWidth === width ? `${height}px` : "";
  legend.keptWidth = width;
}
