"use strict";
// Around and over the map: the grid, and the marks that change with every frame.

function drawGrid(pen, at) {
  const across = niceTicks(at.wx(0), at.wx(at.width), at.width / 110);
  const up = niceTicks(at.wy(at.height), at.wy(0), at.height / 90);
  pen.strokeStyle = colours.faint;
  pen.lineWidth = 1;
  pen.beginPath();
  for (const x of across.ticks) { const s = Math.round(at.sx(x)) + 0.5; pen.moveTo(s, 0); pen.lineTo(s, at.height); }
  for (const y of up.ticks) { const s = Math.round(at.sy(y)) + 0.5; pen.moveTo(0, s); pen.lineTo(at.width, s); }
  pen.stroke();
  pen.fillStyle = colours.soft;
  pen.font = "11px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.textBaseline = "bottom";
  const free = Math.max(60, 26 + pen.measureText(about.unit).width);
  for (const x of across.ticks) if (at.sx(x) > free && at.sx(x) < at.width - 30) pen.fillText(x.toFixed(across.digits), at.sx(x), at.height - 6);
  pen.textAlign = "left";
  pen.textBaseline = "middle";
  for (const y of up.ticks) if (at.sy(y) > 50 && at.sy(y) < at.height - 26) pen.fillText(y.toFixed(up.digits), 6, at.sy(y));
  pen.textBaseline = "bottom";
  pen.fillText(about.unit, 6, at.height - 6);
}

function ring(pen, x, y, radius, colour, width) {
  pen.beginPath();
  pen.arc(x, y, radius, 0, 7);
  pen.strokeStyle = colours.panel;
  pen.lineWidth = width + 2;
  pen.stroke();
  pen.strokeStyle = colour;
  pen.lineWidth = width;
  pen.stroke();
}

// What is marked or selected, above all.
function drawMarks(pen, at) {
  const dot = at.dot, px = (i) => at.sx(run.place_x_m[i]), py = (i) => at.sy(run.place_y_m[i]);
  if (layers.ids.on && at.spacing * at.view.scale > 26) drawIds(pen, at, dot);
  if (layers.plan.on && run.plan_place) drawPlan(pen, at, dot);
  if (layers.merges.on) for (const point of mergePoints()) ring(pen, at.sx(point.x), at.sy(point.y), dot + 6, colours.match, 2);
  if (chosen.link >= 0) {
    const a = run.link_from[chosen.link], b = run.link_to[chosen.link];
    pen.strokeStyle = colours.loop;
    pen.lineWidth = 4;
    pen.beginPath();
    pen.moveTo(px(a), py(a));
    pen.lineTo(px(b), py(b));
    pen.stroke();
    for (const end of [a, b]) ring(pen, px(end), py(end), dot + 4, colours.loop, 2.5);
  }
  if (chosen.place >= 0) {
    const place = chosen.place;
    for (const link of known.linksOf[place]) {
      const other = run.link_from[link] + run.link_to[link] - place;
      pen.strokeStyle = run.link_loop[link] ? colours.loop : colours.ink;
      pen.lineWidth = 2;
      pen.beginPath();
      pen.moveTo(px(place), py(place));
      pen.lineTo(px(other), py(other));
      pen.stroke();
    }
    ring(pen, px(place), py(place), dot + 4, colours.ink, 2.5);
    pen.fillStyle = sessionColour(run.place_session[place]);
    pen.beginPath();
    pen.arc(px(place), py(place), dot + 1, 0, 7);
    pen.fill();
  }
  if (at.hovered >= 0 && at.hovered !== chosen.place) ring(pen, px(at.hovered), py(at.hovered), dot + 3, colours.soft, 1.5);
}

// The start, the recent path, and the robot: below the loop closures.
function drawRobot(pen, at) {
  const dot = at.dot, px = (i) => at.sx(run.place_x_m[i]), py = (i) => at.sy(run.place_y_m[i]);
  if (!known.rows) return;
  if (run.row_x_m[0] === run.row_x_m[0]) {
    pen.fillStyle = colours.panel;
    pen.beginPath();
    pen.arc(at.sx(run.row_x_m[0]), at.sy(run.row_y_m[0]), 4.5, 0, 7);
    pen.fill();
    pen.strokeStyle = colours.ink;
    pen.lineWidth = 1.6;
    pen.stroke();
  }
  if (layers.track.on) {  // the recent path, drawn again over that of earlier laps
    pen.strokeStyle = colours.path;
    pen.lineWidth = 3.5;
    pen.lineJoin = pen.lineCap = "round";
    const seconds = Math.max(5, 0.02 * (run.row_time_s[known.rows - 1] - run.row_time_s[0]));
    line(pen, at, run.row_x_m, run.row_y_m, rowOfTime(run.row_time_s[chosen.row] - seconds), chosen.row);
  }
  const here = run.row_place[chosen.row];
  if (here >= 0) ring(pen, px(here), py(here), dot + 3, colours.robot, 2);
  const x = run.row_x_m[chosen.row], y = run.row_y_m[chosen.row];
  if (x === x) dart(pen, at.sx(x), at.sy(y), run.row_theta_rad[chosen.row], isLost(chosen.row) ? colours.match : colours.robot);
}

function drawPlan(pen, at, dot) {  // the path that `neuroslam plan` found, and a ring at its goal
  const place = Array.from(run.plan_place), xs = place.map((i) => run.place_x_m[i]), ys = place.map((i) => run.place_y_m[i]);
  pen.lineJoin = pen.lineCap = "round";
  for (const [colour, width] of [[colours.panel, 7], [colours.plan, 4]]) {
    pen.strokeStyle = colour;
    pen.lineWidth = width;
    line(pen, at, xs, ys);
  }
  ring(pen, at.sx(xs.at(-1)), at.sy(ys.at(-1)), dot + 7, colours.plan, 2.5);
}

function dart(pen, x, y, heading, colour) {
  pen.save();
  pen.translate(x, y);
  pen.rotate(-heading);
  pen.beginPath();
  for (const [i, [a, b]] of [[14, 0], [-9, 8], [-4.5, 0], [-9, -8]].entries()) i ? pen.lineTo(a, b) : pen.moveTo(a, b);
  pen.closePath();
  pen.fillStyle = colour;
  pen.fill();
  pen.strokeStyle = colours.ink;
  pen.lineWidth = 1.2;
  pen.lineJoin = "round";
  pen.stroke();
  pen.restore();
}

function drawIds(pen, at, dot) {
  pen.font = "11px system-ui, sans-serif";
  pen.textAlign = "left";
  pen.textBaseline = "middle";
  pen.lineWidth = 3;
  pen.strokeStyle = colours.panel;
  pen.fillStyle = colours.soft;
  const taken = new Set();
  for (let i = 0; i < known.places; i++) {
    const x = at.sx(run.place_x_m[i]) + dot + 3, y = at.sy(run.place_y_m[i]) - dot - 3;
    if (x < 0 || y < 0 || x > at.width || y > at.height) continue;
    const cell = `${Math.round(x / 26)},${Math.round(y / 14)}`;
    if (taken.has(cell)) continue;
    taken.add(cell);
    pen.strokeText(i, x, y);
    pen.fillText(i, x, y);
  }
}

// Positions of merges on the final map, where the reports determine them.
function mergePoints() {
  return about.merges.flatMap((report) => {
    const row = report.frame === null || !known.rows ? -1 : rowOfFrame(report.frame);
    const place = row >= 0 ? run.row_place[row] : report.place ?? -1;
    return place >= 0 && place < known.places ? [{ x: run.place_x_m[place], y: run.place_y_m[place], row, place }] : [];
  });
}
