"use strict";
// The slider, playback, keys; and the start of the page.

const SPEEDS = [0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500];
const PLAYED_S = 40;  // duration of a whole run at the initial speed

const player = {
  last: 0, time: 0,
  play() {
    if (chosen.playing || known.rows < 2) return;
    if (chosen.row === known.rows - 1) chooseRow(0);
    chosen.playing = true;
    this.last = performance.now();
    this.time = run.row_time_s[chosen.row];
    this.show();
    requestAnimationFrame((now) => this.step(now));
  },
  pause() {
    chosen.playing = false;
    this.show();
  },
  toggle() { chosen.playing ? this.pause() : this.play(); },
  step(now) {
    if (!chosen.playing) return;
    const passed = Math.min(0.25, (now - this.last) / 1000) * Number($("speed").value);
    this.last = now;
    if (rowOfTime(this.time) !== chosen.row) this.time = run.row_time_s[chosen.row];  // the slider was moved
    this.time += passed;
    chooseRow(rowOfTime(this.time));
    if (chosen.row >= known.rows - 1) this.pause();
    else requestAnimationFrame((next) => this.step(next));
  },
  show() {
    $("play").textContent = chosen.playing ? "❚❚" : "▶";
    $("play").setAttribute("aria-label", chosen.playing ? "Pause" : "Play");
  },
};

function showClock() {
  const row = chosen.row, first = run.row_time_s[0], last = run.row_time_s[known.rows - 1];
  $("slider").value = row;
  $("clock").replaceChildren(
    make("b", { text: `frame ${run.row_frame[row]}` }), make("br"),
    `${duration(run.row_time_s[row] - first)} of ${duration(last - first)}`);
  $("slider").setAttribute("aria-valuetext", `frame ${run.row_frame[row]}, ${duration(run.row_time_s[row] - first)}, experience ${run.row_place[row]}`);
}

// Strip above the slider: new experiences, revisits, merges, and times when the robot was lost.
function paintStrip() {
  const canvas = $("strip"), width = canvas.clientWidth, height = 18;
  if (!width || !known.rows) return;
  const pen = fitCanvas(canvas, width, height), x = (row) => (row / Math.max(1, known.rows - 1)) * width;
  pen.fillStyle = colours.faint;
  pen.fillRect(0, 0, width, height);
  pen.fillStyle = colours.lost;
  for (const [a, b] of about.lost) pen.fillRect(x(a), 0, Math.max(2, x(b) - x(a)), height);
  const bins = new Map();
  for (let row = 0; row < known.rows; row++) {
    const action = run.row_action[row];
    if (!action) continue;
    const column = Math.round(x(row)), bin = bins.get(column) ?? [0, 0];
    bin[action === 1 ? 0 : 1]++;
    bins.set(column, bin);
  }
  for (const [kind, colour] of [[0, colours.map], [1, colours.loop]]) {
    pen.fillStyle = colour;
    for (const [column, bin] of bins) if (bin[kind]) pen.fillRect(column - 0.5, kind ? 9.5 : 1, 1, 7.5);
  }
  pen.fillStyle = colours.match;
  for (const report of about.merges) if (report.frame !== null) pen.fillRect(x(rowOfFrame(report.frame)) - 1, 0, 2.5, height);
}

function startPlayer() {
  $("slider").max = Math.max(0, known.rows - 1);
  $("slider").addEventListener("input", (event) => chooseRow(Number(event.target.value)));
  $("play").addEventListener("click", () => player.toggle());
  $("back").addEventListener("click", () => chooseRow(chosen.row - 1));
  $("forth").addEventListener("click", () => chooseRow(chosen.row + 1));
  const seconds = known.rows ? run.row_time_s[known.rows - 1] - run.row_time_s[0] : 0;
  for (const speed of SPEEDS) $("speed").append(make("option", { value: speed, text: `${speed}×` }));
  $("speed").value = SPEEDS.find((speed) => seconds / speed <= PLAYED_S) ?? SPEEDS.at(-1);
  watch("row", showClock);
  watch("colours", paintStrip);
  new ResizeObserver(paintStrip).observe($("strip"));
  addEventListener("keydown", (event) => {
    const busy = event.key === " " ? "input:not(#slider), select, button, summary, a, #map"
      : event.key.startsWith("Arrow") ? "input, select, [role=tab], #map" : "input, select, [role=tabpanel], #map";
    if (event.ctrlKey || event.metaKey || event.altKey || !known.rows || event.target.matches(busy)) return;
    const far = event.shiftKey ? 10 : 1;
    const act = {
      " ": () => player.toggle(),
      ArrowLeft: () => chooseRow(chosen.row - far), ArrowRight: () => chooseRow(chosen.row + far),
      Home: () => chooseRow(0), End: () => chooseRow(known.rows - 1),
    }[event.key];
    if (act) {
      act();
      event.preventDefault();
    }
  });
}

// Mouse, touch and keys on the map.
function listen() {
  const canvas = map.canvas, fingers = new Map();
  let moved = 0;
  const at = (event) => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, at(event));
    if (fingers.size === 1) moved = 0;
    $("tip").hidden = true;
  });
  canvas.addEventListener("pointermove", (event) => {
    const [x, y] = at(event), before = fingers.get(event.pointerId);
    if (!before) {
      hover(x, y);
      return;
    }
    if (fingers.size === 2) {
      const [other] = [...fingers].filter(([id]) => id !== event.pointerId).map(([, point]) => point);
      const apart = (a) => Math.hypot(a[0] - other[0], a[1] - other[1]) || 1;
      map.zoom(apart([x, y]) / apart(before), (x + other[0]) / 2, (y + other[1]) / 2);
    } else {
      moved += Math.abs(x - before[0]) + Math.abs(y - before[1]);
      if (moved > 4) {
        canvas.classList.add("moving");
        map.pan(x - before[0], y - before[1]);
      }
    }
    fingers.set(event.pointerId, [x, y]);
  });
  const lift = (event) => {
    fingers.delete(event.pointerId);
    canvas.classList.remove("moving");
  };
  canvas.addEventListener("pointerup", (event) => {
    const [x, y] = at(event), pick = fingers.size === 1 && moved <= 4;
    lift(event);
    if (pick) {
      const place = map.nearest(x, y, 16);
      if (place >= 0) choosePlace(place, false);
      else if (chosen.place >= 0 || chosen.link >= 0) { chosen.link = -1; choosePlace(-1); }
    }
  });
  canvas.addEventListener("pointercancel", lift);
  canvas.addEventListener("pointerleave", () => hover(-99, -99));
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 20 : 1;
    map.zoom(Math.exp(-Math.max(-240, Math.min(240, event.deltaY * lines)) * 0.0018), ...at(event));
  }, { passive: false });
  canvas.addEventListener("dblclick", (event) => map.zoom(2, ...at(event)));
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const next = (by) => known.places && choosePlace((Math.max(chosen.place, by > 0 ? -1 : 0) + by + known.places) % known.places);
    const act = {
      ArrowLeft: () => map.pan(60, 0), ArrowRight: () => map.pan(-60, 0), ArrowUp: () => map.pan(0, 60), ArrowDown: () => map.pan(0, -60),
      "+": () => map.zoom(1.3), "=": () => map.zoom(1.3), "-": () => map.zoom(1 / 1.3), 0: () => map.fit(),
      n: () => next(1), p: () => next(-1), " ": () => player.toggle(), Escape: () => choosePlace(-1),
      Enter: () => { const place = map.nearest(map.width / 2, map.height / 2, 1e9); if (place >= 0) choosePlace(place); },
    }[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (act) { act(); event.preventDefault(); event.stopPropagation(); }
  });
  $("zoom-in").addEventListener("click", () => map.zoom(1.5));
  $("zoom-out").addEventListener("click", () => map.zoom(1 / 1.5));
  $("fit").addEventListener("click", () => map.fit());
}

function hover(x, y) {
  const place = map.nearest(x, y, 12), tip = $("tip");
  if (place !== map.hovered) { map.hovered = place; map.draw(); }
  map.canvas.classList.toggle("over", place >= 0);
  tip.hidden = place < 0;
  if (place < 0) return;
  tip.textContent = `experience ${place} · ${many(known.visits[place].length, "visit")}`;
  tip.style.left = `${Math.min(x + 14, map.width - tip.offsetWidth - 8)}px`;
  tip.style.top = `${Math.max(4, y - 30)}px`;
}

async function start() {
  await readArrays();
  chosen.row = Math.max(0, known.rows - 1);
  document.body.classList.toggle("no-frames", !known.rows);
  startTabs();
  startHeadline();
  startLayers();
  startCharts();
  startCells();
  startActivity();
  startPopulations();
  startSessions();
  startMetrics();
  startConfig();
  startNotes();
  startPlayer();
  watch("row", showNow);
  watch("place", () => { showPlace(); markLoop(); });
  watch("link", markLoop);
  watch("colours", showPlace);
  readColours();
  map.start();
  showLoops();
  if (known.rows) showClock();
  showNow();
  showPlace();
  if (!known.rows) showTab("place");
  paintStrip();
  document.documentElement.dataset.ready = "yes";
}

start().catch((error) => {
  $("fault").hidden = false;
  $("fault").textContent = `This page cannot be shown here: ${error.message}`;
  throw error;
});
