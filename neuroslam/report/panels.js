"use strict";
// Beside the map: the current frame, the selected experience, the loop closures.

const TABS = ["now", "place", "loops"];

function showTab(name) {
  for (const tab of TABS) {
    const is = tab === name, button = $(`tab-${tab}`);
    button.setAttribute("aria-selected", is);
    button.tabIndex = is ? 0 : -1;
    $(tab).hidden = !is;
  }
}

function startTabs() {
  for (const [i, tab] of TABS.entries()) {
    const button = $(`tab-${tab}`);
    button.addEventListener("click", () => showTab(tab));
    button.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (!step) return;
      const next = TABS[(i + step + TABS.length) % TABS.length];
      showTab(next);
      $(`tab-${next}`).focus();
      event.stopPropagation();
    });
  }
  showTab("now");
}

const placeButton = (place, text = `experience ${place}`) =>
  make("button", { class: "as-link", type: "button", text, onclick: () => choosePlace(place) });

const rowButton = (row, text) =>
  make("button", { class: "as-link", type: "button", text, onclick: () => chooseRow(row) });

function facts(pairs) {
  const list = make("dl");
  for (const [name, ...values] of pairs) {
    if (values[0] === null || values[0] === undefined) continue;
    list.append(make("dt", { text: name }), make("dd", {}, ...values));
  }
  return list;
}

function noPicture() {
  if (about.picture_notes.length) return about.picture_notes[0];
  return "no picture";
}

function picture(source, caption, alt) {
  const shown = source
    ? make("img", { src: source, alt })
    : make("div", { class: "nothing", text: noPicture() });
  return make("figure", {}, shown, make("figcaption", { text: caption }));
}

// A template of gradients: in each cell a stroke along the edge for each orientation, bright where strong.
function strokes(template, maps) {
  const [, height, width] = run.templates.shape, rows = height / maps, cell = 9;
  const canvas = make("canvas", { class: "template", width: cell * width, height: cell * rows, role: "img", "aria-label": `Template ${template}` });
  const pen = canvas.getContext("2d"), first = template * width * height;
  pen.fillRect(0, 0, canvas.width, canvas.height);
  pen.strokeStyle = "#fff";
  for (let i = 0; i < width * height; i++) {
    const x = cell * (i % width + 0.5), row = Math.floor(i / width), y = cell * (row % rows + 0.5);
    const angle = (Math.floor(row / rows) / maps + 0.5) * Math.PI, dx = 0.5 * cell * Math.cos(angle), dy = 0.5 * cell * Math.sin(angle);
    pen.globalAlpha = run.templates[first + i] / 255;
    pen.beginPath();
    pen.moveTo(x - dx, y - dy);
    pen.lineTo(x + dx, y + dy);
    pen.stroke();
  }
  return canvas;
}

// The template of an experience, drawn from its bytes.
function templateFigure(template, note = "") {
  const [n, height, width] = run.templates.shape;
  const figure = make("figure");
  if (template < 0 || template >= n) {
    figure.append(make("div", { class: "nothing", text: "no template" }), make("figcaption", { text: note }));
    return figure;
  }
  const maps = about.orientations;
  const madeOf = about.features !== "grey" ? ", features of a network" : maps ? ", edges" : "";
  if (maps) {
    figure.append(strokes(template, maps), make("figcaption", { text: `template ${template}${note}${madeOf}` }));
    return figure;
  }
  const canvas = make("canvas", { class: "template", width, height, role: "img", "aria-label": `Template ${template}` });
  const pen = canvas.getContext("2d"), image = pen.createImageData(width, height), first = template * width * height;
  for (let i = 0; i < width * height; i++) {
    image.data.fill(run.templates[first + i], 4 * i, 4 * i + 3);
    image.data[4 * i + 3] = 255;
  }
  pen.putImageData(image, 0, 0);
  canvas.style.aspectRatio = Math.min(4, Math.max(1.2, width / height));
  figure.append(canvas, make("figcaption", { text: `template ${template}${note}${madeOf}` }));
  return figure;
}

const ACTION_TEXT = {
  none: "same experience", create: "new experience", link: "known experience",
  set: "pose set: map joined, or relocalised",
};

function showNow() {
  const panel = $("now-facts"), row = chosen.row;
  if (!known.rows) {
    panel.replaceChildren(make("p", { class: "soft", text: "This map was merged from brain files: it has no frames." }));
    return;
  }
  const place = run.row_place[row], frame = run.row_frame[row], action = about.actions[run.row_action[row]];
  const taken = pictureOfRow(row);
  const shownFrame = taken && run.row_frame[taken.row];
  const caption = taken ? (shownFrame === frame ? `frame ${frame}` : `frame ${shownFrame}, nearest picture`) : `frame ${frame}`;
  const error = run.row_match_error[row], lost = isLost(row);
  const hasViews = run.templates.shape[0] > 0;
  const poses = !about.cells.includes("pose") ? null
    : `${run.row_pose_x[row].toFixed(1)}, ${run.row_pose_y[row].toFixed(1)}, ${run.row_pose_theta[row].toFixed(1)} cells`;
  const at = run.row_x_m[row] === run.row_x_m[row]
    ? `${run.row_x_m[row].toFixed(2)}, ${run.row_y_m[row].toFixed(2)} ${about.unit}, ${degrees(run.row_theta_rad[row])}`
    : "on a map that is not joined";
  panel.replaceChildren(
    make("span", { class: `act ${lost ? "lost" : action}`, text: lost ? "lost: walls disagree with the map" : place < 0 ? "no experience of this map" : ACTION_TEXT[action] }),
    hasViews || taken
      ? make("div", { class: "pair" },
        picture(taken?.source, caption, `Picture of ${caption}`),
        hasViews ? templateFigure(place < 0 ? -1 : run.place_template[place], " of its experience") : null)
      : "",
    facts([
      ["frame", `${frame}, ${duration(run.row_time_s[row] - run.row_time_s[0])} after the start`],
      ["experience", place >= 0 ? placeButton(place) : "none"],
      ["position", at],
      ["motion", `${run.row_v_m_s[row].toFixed(2)} ${about.unit}/s, ${degrees(run.row_w_rad_s[row])}/s`],
      ["match error", hasViews ? matchMeter(error) : null],
      ["decision", decision(row)],
      ["pose cells", poses],
      ["so far", `${many(run.row_n_experiences[row], "experience")}, ${many(run.row_n_links[row], "link")}`],
    ]),
  );
}

// Which check stopped a loop at this frame, or let it pass; `neuroslam why` measures all of them.
function decision(row) {
  if (!run.row_cells_apart || run.row_template[row] < 0) return null;
  const error = run.row_match_error[row], apart = run.row_cells_apart[row], limit = about.create_threshold;
  const action = about.actions[run.row_action[row]];
  if (action === "create" && apart !== apart) {
    return error < 0 ? "no loop: there is no earlier view" : `no loop: match error ${error.toFixed(4)}, expected at most ${about.threshold}`;
  }
  const cells = `pose cells ${apart.toFixed(1)} cells from an experience with this view`;
  if (action === "create") return `no loop: ${cells}, expected at most ${limit}`;
  if (action === "link" || action === "set") return `known experience: ${cells}, at most ${limit}`;
  return null;
}

function matchMeter(error) {
  if (error < 0) return "no template to compare with";
  const top = 2 * about.threshold, share = (value) => `${Math.min(100, (100 * value) / top)}%`;
  const is_new = error > about.threshold;
  const bar = make("i", { class: is_new ? "over" : "", style: { width: share(error) } });
  return make("span", {}, `${error.toFixed(4)}, ${is_new ? "new view" : "known view"}`,
    make("div", { class: "meter", title: `threshold ${about.threshold}` }, bar, make("b", { style: { left: "50%" } })));
}

function showPlace() {
  const panel = $("place"), place = chosen.place;
  panel.classList.toggle("empty", place < 0);  // left out of a print
  if (!known.places) {
    panel.replaceChildren(make("p", { class: "soft", text: "The map has no experiences." }));
    return;
  }
  const step = (by) => choosePlace((Math.max(place, by > 0 ? -1 : 0) + by + known.places) % known.places);
  const jump = make("input", { type: "number", min: 0, max: known.places - 1, "aria-label": "Go to experience", placeholder: "id",
    onchange: (event) => {
      const id = Number(event.target.value);
      if (event.target.value !== "" && Number.isInteger(id) && id >= 0 && id < known.places) choosePlace(id);
    } });
  const head = make("div", { class: "picker" },
    make("h3", { text: place < 0 ? "No experience selected" : `Experience ${place}` }), jump,
    make("button", { type: "button", text: "‹", "aria-label": "Previous experience", onclick: () => step(-1) }),
    make("button", { type: "button", text: "›", "aria-label": "Next experience", onclick: () => step(1) }));
  if (place < 0) {
    panel.replaceChildren(head, make("p", { class: "soft", text: "Click an experience on the map, or type its id." }));
    return;
  }
  const template = run.place_template[place], session = about.sessions[run.place_session[place]];
  const number = run.place_picture[place], visits = known.visits[place], first = run.place_first_frame[place];
  panel.replaceChildren(head,
    template >= 0 || number >= 0
      ? make("div", { class: "pair" },
        picture(number >= 0 ? pictureSource(number) : null, `frame ${first}, its first`, `Picture of the first frame of experience ${place}`),
        template >= 0 ? templateFigure(template) : null)
      : "",
    facts([
      ["position", `${run.place_x_m[place].toFixed(2)}, ${run.place_y_m[place].toFixed(2)} ${about.unit}, ${degrees(run.place_theta_rad[place])}`],
      ["created", `at frame ${first}` + (session?.own ? "" : " of an earlier session")],
      ["session", session ? make("span", {}, make("i", { class: "swatch", style: { background: sessionColour(run.place_session[place]) } }), session.name) : null],
      ["time spent", visits.length ? `${duration(known.seconds[place])} in ${many(visits.length, "visit")}` : "not visited in this run"],
    ]),
    make("h3", { text: `Links (${known.linksOf[place].length})` }), linkChips(place),
    make("h3", { text: `Frames of the visits (${many(visits.length, "visit")})` }), visitChips(visits));
}

function linkChips(place) {
  const chips = make("div", { class: "chips" });
  for (const link of known.linksOf[place]) {
    const to = run.link_to[link], other = run.link_from[link] + to - place;
    chips.append(make("button", {
      type: "button", class: run.link_loop[link] ? "loop" : "",
      title: `${metres(run.link_distance_m[link])} measured, residual ${metres(run.link_off_m[link])} on the map` + (run.link_loop[link] ? ", closes a loop" : ""),
      text: `${to === other ? "to" : "from"} ${other} · ${metres(run.link_distance_m[link])}`,
      onclick: () => choosePlace(other),
    }));
  }
  if (!chips.childElementCount) chips.append(make("span", { class: "soft", text: "none" }));
  return chips;
}

function visitChips(visits, shown = 120) {
  const chips = make("div", { class: "chips" });
  for (const [first, last] of visits.slice(0, shown)) {
    const a = run.row_frame[first], b = run.row_frame[last];
    chips.append(make("button", { type: "button", text: a === b ? `${a}` : `${a}–${b}`, onclick: () => chooseRow(first) }));
  }
  if (visits.length > shown) {
    chips.append(make("button", { type: "button", text: `all ${visits.length}`, onclick: (event) => event.target.parentElement.replaceWith(visitChips(visits, Infinity)) }));
  }
  if (!visits.length) chips.append(make("span", { class: "soft", text: "none in this run" }));
  return chips;
}

const LOOPS_SHOWN = 300;

function showLoops(shown = LOOPS_SHOWN) {
  const panel = $("loops");
  if (!known.loops.length) {
    panel.replaceChildren(make("p", { class: "soft", text: "No loop closures." }));
    return;
  }
  const rows = known.loops.slice(0, shown).map((link) => {
    const row = known.linkRow[link], to = run.link_to[link], away = row < 0 ? null : awaySeconds(to, row);
    const go = make("button", { class: "as-link", type: "button", text: row < 0 ? "earlier" : `${run.row_frame[row]}`, "aria-label": `Go to the loop closure from experience ${run.link_from[link]} to ${to}` });
    return make("tr", { class: "go", "data-link": link, onclick: () => chooseLink(link) },
      make("td", {}, go), make("td", { text: `${run.link_from[link]} → ${to}` }),
      make("td", { class: "number", text: away === null ? "–" : duration(away) }),
      make("td", { class: "number", text: metres(run.link_off_m[link]) }));
  });
  const head = make("tr", {}, make("th", { text: "frame", title: "first frame that made or followed this link" }), make("th", { text: "experiences" }),
    make("th", { class: "number", text: "time away", title: "since the last visit of the target" }),
    make("th", { class: "number", text: "residual", title: "difference between the link and the final map" }));
  panel.replaceChildren(
    make("p", { class: "lead", text: `${many(known.loops.length, "loop closure")}: links between experiences that both existed before. Click one to show it.` }),
    make("table", {}, make("thead", {}, head), make("tbody", {}, ...rows)),
    known.loops.length > shown ? make("button", { type: "button", text: `Show all ${known.loops.length}`, onclick: () => showLoops(Infinity) }) : "");
}

function markLoop() {
  for (const row of $("loops").querySelectorAll("tr.chosen")) row.classList.remove("chosen");
  const row = $("loops").querySelector(`tr[data-link="${chosen.link}"]`);
  if (row) row.classList.add("chosen");
}
