"use strict";
// Charts over time, with a mark at the current frame.

const CHART = { left: 54, right: 10, top: 6, bottom: 18 };

function timeSpan() {
  const first = run.row_time_s[0], last = run.row_time_s[known.rows - 1];
  return [first, last > first ? last : first + 1];
}

// One chart: series of { name, colour, value(row), dots, of(row) } with rows in `at` or all of them.
function makeChart(title, unit, height, series, { low = null, high = null, limit = null, digits = 2, step = null } = {}) {
  const readouts = series.map((one) => make("b", { text: "" }));
  const head = make("div", { class: "head" }, make("h3", { text: title }), unit ? make("span", { text: unit }) : null,
    ...series.map((one, i) => {
      const kind = one.dots ? "key-dot" : `key-line${one.dash ? " dashed" : ""}${one.width > 3 ? " thick" : ""}`;
      const key = make("i", { class: kind });
      one.key = key;
      return make("span", {}, key, one.name, readouts[i]);
    }));
  const canvas = make("canvas", { role: "img", "aria-label": `${title}: ${series.map((one) => one.name).join(", ")}` });
  const now = make("div", { class: "now" });
  const plot = make("div", { class: "plot" }, canvas, now);
  const card = make("div", { class: "chart card" }, head, plot);
  const chart = {
    card, width: 0,
    resize() {
      const width = plot.clientWidth;
      if (width && width !== this.width) { this.width = width; this.paint(); }
    },
    paint() {
      if (!this.width) return;
      canvas.style.height = `${height}px`;
      const pen = fitCanvas(canvas, this.width, height);
      this.scale(pen);
      for (const one of series) {
        one.key.style[one.dots ? "background" : "borderColor"] = one.colour();
        drawSeries(pen, one, this);
      }
      this.mark();
    },
    scale(pen) {
      let bottom = low ?? Infinity, top = high ?? -Infinity;
      for (const one of series) {
        const n = one.at ? one.at.length : known.rows;
        for (let i = 0; i < n; i++) {
          const value = one.value(i);
          if (!(value === value)) continue;
          if (low === null && value < bottom) bottom = value;
          if (high === null && value > top) top = value;
        }
      }
      if (limit !== null && high === null) top = Math.max(top, 1.25 * limit);
      if (!(top > bottom)) { bottom = Number.isFinite(bottom) ? bottom : 0; top = bottom + 1; }
      const room = 0.05 * (top - bottom), inner = height - CHART.top - CHART.bottom;
      if (high === null) top += room;
      if (low === null) bottom -= room;
      const [t0, t1] = timeSpan();
      this.x = (time) => CHART.left + ((time - t0) / (t1 - t0)) * (this.width - CHART.left - CHART.right);
      this.y = (value) => CHART.top + ((top - value) / (top - bottom)) * inner;
      const up = step ? { ticks: [0, 1, 2, 3, 4].map((i) => i * step), digits: 0 } : niceTicks(bottom, top, inner / 30), across = niceTicks(0, t1 - t0, this.width / 110);
      pen.fillStyle = colours.lost;
      for (const [a, b] of about.lost) pen.fillRect(this.x(run.row_time_s[a]), CHART.top, Math.max(1.5, this.x(run.row_time_s[b]) - this.x(run.row_time_s[a])), inner);
      pen.strokeStyle = colours.faint;
      pen.fillStyle = colours.soft;
      pen.font = "11px system-ui, sans-serif";
      pen.textAlign = "right";
      pen.textBaseline = "middle";
      pen.beginPath();
      for (const value of up.ticks) {
        const y = Math.round(this.y(value)) + 0.5;
        pen.moveTo(CHART.left, y);
        pen.lineTo(this.width - CHART.right, y);
        pen.fillText(value.toFixed(up.digits), CHART.left - 6, y);
      }
      pen.stroke();
      pen.textAlign = "center";
      pen.textBaseline = "bottom";
      for (const time of across.ticks) pen.fillText(`${time.toFixed(across.digits)}${time ? "" : " s"}`, this.x(t0 + time), height);
      if (limit !== null) {
        pen.strokeStyle = colours.ink;
        pen.setLineDash([4, 4]);
        pen.beginPath();
        pen.moveTo(CHART.left, this.y(limit));
        pen.lineTo(this.width - CHART.right, this.y(limit));
        pen.stroke();
        pen.setLineDash([]);
      }
    },
    mark() {
      if (!this.width) return;
      now.style.transform = `translateX(${this.x(run.row_time_s[chosen.row]) - 0.75}px)`;
      series.forEach((one, i) => {
        let at = chosen.row;
        if (one.at) at = lastNotAbove(one.at, chosen.row);
        const value = one.value(at);
        readouts[i].textContent = value === value ? value.toFixed(one.digits ?? digits) : "–";
      });
    },
  };
  const seek = (event) => {
    const [t0, t1] = timeSpan(), x = event.clientX - plot.getBoundingClientRect().left;
    chooseRow(rowOfTime(t0 + ((x - CHART.left) / (chart.width - CHART.left - CHART.right)) * (t1 - t0)));
  };
  plot.addEventListener("pointerdown", (event) => { plot.setPointerCapture(event.pointerId); seek(event); });
  plot.addEventListener("pointermove", (event) => { if (event.buttons & 1) seek(event); });
  new ResizeObserver(() => chart.resize()).observe(plot);
  return chart;
}

function drawSeries(pen, one, chart) {
  const n = one.at ? one.at.length : known.rows, bottom = chart.y;
  const time = (i) => run.row_time_s[one.at ? one.at[i] : i];
  pen.strokeStyle = pen.fillStyle = one.colour();
  if (one.dots) {
    const size = n > 4000 ? 1.6 : n > 1000 ? 2.4 : 3.4;
    let column = -1, taken = null;  // dots on the same pixel are drawn once
    for (let i = 0; i < n; i++) {
      const value = one.value(i);
      if (!(value === value)) continue;
      const x = chart.x(time(i)), y = bottom(value);
      if (Math.round(x) !== column) { column = Math.round(x); taken = new Set(); }
      if (taken.has(Math.round(y))) continue;
      taken.add(Math.round(y));
      pen.fillRect(x - size / 2, y - size / 2, size, size);
    }
    return;
  }
  // In each column of pixels only the least, the greatest and the last value are drawn.
  pen.lineWidth = one.width ?? 1.4;
  pen.setLineDash(one.dash ?? []);
  pen.lineJoin = "round";
  pen.beginPath();
  let down = false, column = null, least = 0, most = 0, last = 0, before = NaN;
  const finish = () => {
    if (column === null) return;
    pen.lineTo(column, least);
    if (most !== least) pen.lineTo(column, most);
    pen.lineTo(column, last);
  };
  for (let i = 0; i < n; i++) {
    const value = one.value(i), x = Math.round(2 * chart.x(time(i))) / 2, y = bottom(value);
    const breaks = !(value === value) || (one.around && Math.abs(value - before) > one.around / 2);
    before = value;
    if (breaks) { finish(); column = null; down = false; }
    if (!(value === value)) continue;
    if (!down) { pen.moveTo(x, y); down = true; column = x; least = most = last = y; continue; }
    if (x !== column) { finish(); column = x; least = most = last = y; }
    least = Math.min(least, y);
    most = Math.max(most, y);
    last = y;
  }
  finish();
  pen.stroke();
  pen.setLineDash([]);
}

const charts = [];

function startCharts() {
  const add = (...settings) => { const chart = makeChart(...settings); charts.push(chart); $("charts").append(chart.card); };
  if (!known.rows) {
    $("time").hidden = true;
    return;
  }
  const column = (name) => (i) => run[name][i], none = NaN, limit = about.threshold;
  const error = run.row_match_error;
  if (run.templates.shape[0]) {
    add("View matches", "match error: mean difference to the nearest template, 0 to 1", 130, [
      { name: "known view", dots: true, digits: 3, colour: () => colours.map, value: (i) => (error[i] >= 0 && error[i] <= limit ? error[i] : none) },
      { name: "new view", dots: true, digits: 3, colour: () => colours.loop, value: (i) => (error[i] > limit ? error[i] : none) },
    ], { low: 0, limit });
    add("Templates", "matched template of each frame, by id", 110, [
      { name: "template", dots: true, digits: 0, colour: () => colours.map, value: (i) => (run.row_template[i] >= 0 ? run.row_template[i] : none) },
    ], { low: 0 });
  }
  const here = (action) => (i) => (run.row_place[i] >= 0 && run.row_action[i] === action ? run.row_place[i] : none);
  add("Experiences", "current experience of each frame, by id on the final map; a step down is a revisit", 150, [
    { name: "unchanged", dots: true, digits: 0, colour: () => colours.odometry, value: here(0) },
    { name: "new", dots: true, digits: 0, colour: () => colours.map, value: here(1) },
    { name: "revisit", dots: true, digits: 0, colour: () => colours.loop, value: (i) => (run.row_action[i] >= 2 && run.row_place[i] >= 0 ? run.row_place[i] : none) },
  ], { low: 0 });
  add("Size of the map", "counts", 110, [
    // The counts are often equal: a wide line, a line on it, and dashes on both.
    { name: "experiences", digits: 0, width: 5, colour: () => colours.third, value: column("row_n_experiences") },
    { name: "links", digits: 0, width: 2, colour: () => colours.loop, value: column("row_n_links") },
    ...(run.templates.shape[0] ? [{ name: "templates", digits: 0, width: 2, dash: [5, 7], colour: () => colours.ink, value: column("row_n_templates") }] : []),
  ], { low: 0 });
  const [nXY, nTheta] = about.torus;
  if (about.cells.includes("pose")) {
    add("Pose cells", "centre of the packet on the torus, in cells", 120, [
      { name: "x", around: nXY, digits: 1, colour: () => colours.map, value: column("row_pose_x") },
      { name: "y", around: nXY, digits: 1, colour: () => colours.loop, value: column("row_pose_y") },
    ], { low: 0, high: nXY });
    add("Heading of the packet", "degrees", 90, [
      { name: "θ", around: 360, digits: 0, colour: () => colours.path, value: (i) => (360 * run.row_pose_theta[i]) / nTheta },
    ], { low: 0, high: 360, step: 90 });
  }
  const curve = (name, title, unit, colour, settings) => {
    if (run[`${name}_row`] && (name === "doubt_s" || run[`${name}_value`].some((value) => value))) add(title, unit, 80, [{ name: "", at: run[`${name}_row`], digits: 3, colour, value: column(`${name}_value`) }], settings);
  };
  curve("doubt_s", "Time without recognition", "seconds; rises while walls disagree with the map; the animal is lost above a threshold", () => colours.match, { low: 0 });
  curve("peak", "Peak activity of the pose cells", "share of the total activity", () => colours.path, { low: 0 });
  curve("largest_correction", "Relaxation", `largest correction of a pose in a frame, ${about.unit} or rad`, () => colours.second, { low: 0 });
  add("Speed", "m/s", 90, [{ name: "v", colour: () => colours.map, value: column("row_v_m_s") }]);
  add("Turn rate", "degrees/s; left is positive", 90, [{ name: "ω", digits: 1, colour: () => colours.path, value: (i) => (run.row_w_rad_s[i] * 180) / Math.PI }]);
  watch("row", () => charts.forEach((chart) => chart.mark()));
  watch("colours", () => charts.forEach((chart) => chart.paint()));
}
