"use strict";
// The map: pan, zoom, selection. The parts that do not change with every frame are kept as two
// bitmaps larger than the window, so that the cost of panning does not depend on the map's size.

const SPARE = 0.3;  // of the window, on each side of it
const SETTLED_MS = 140;
const QUICK_MS = 7;  // sheets that take less are redrawn at once

const layers = {
  links: { name: "Links", on: true },
  loops: { name: "Loop closures", on: true },
  track: { name: "Path up to the frame", on: true },
  whole: { name: "Whole path", on: false },
  odometry: { name: "Odometry alone", on: false },
  truth: { name: "Truth", on: true },
  walls: { name: "Remembered walls", on: true },
  landmarks: { name: "Landmarks", on: true },
  plan: { name: "Planned path", on: true },
  merges: { name: "Merge points", on: true },
  ids: { name: "Ids of experiences", on: true },
};
const colourings = { session: "session", visits: "visits", seconds: "time spent", since: "first visit" };

const map = {
  canvas: $("map"), width: 0, height: 0,
  view: { scale: 1, x: 0, y: 0 },
  colouring: "session", hovered: -1, settleTimer: 0, drawn: 0,
  rest: { x: 0, y: 0, scale: 1 },

  start() {
    this.canvas.style.background = "transparent";
    const growing = (paintOn) => makeSheet((pen, at, dot) => paintOn(pen, at, dot, -1), paintOn);
    this.below = [makeSheet(paintStill), growing(paintPlaces), growing(paintPath)];
    this.above = growing(paintLoops);  // over the robot, which would hide them
    this.sheets = [...this.below, this.above];
    this.spread();
    new ResizeObserver(() => this.resize()).observe(this.canvas);
    watch("row", () => this.draw());
    watch("place", () => this.draw());
    watch("link", () => this.draw());
    watch("colours", () => { this.forget(); this.paint(); });
    this.resize();
    this.fit();
    listen();
  },
  // Median distance of linked experiences, for the size of their dots.
  spread() {
    const lengths = [];
    for (let i = 0; i < known.links; i += 1 + (known.links >> 11)) {
      const a = run.link_from[i], b = run.link_to[i];
      lengths.push(Math.hypot(run.place_x_m[a] - run.place_x_m[b], run.place_y_m[a] - run.place_y_m[b]));
    }
    lengths.sort((a, b) => a - b);
    this.spacing = lengths[lengths.length >> 1] || 0.2;
    this.leastDot = Math.max(1.3, Math.min(3, 40 / Math.sqrt(known.places || 1)));
  },
  resize() {
    const box = this.canvas.parentElement.getBoundingClientRect();
    if (!box.width || (box.width === this.width && box.height === this.height)) return;
    const first = !this.width;
    this.width = box.width;
    this.height = box.height;
    this.forget();
    if (!first) this.paint();
  },
  forget() { for (const sheet of this.sheets) sheet.painted = null; },
  draw() {
    if (this.drawn) return;
    this.drawn = requestAnimationFrame(() => { this.drawn = 0; this.paint(); });
  },
  paint(settled = false) {
    if (!this.width) return;
    const pen = fitCanvas(this.canvas, this.width, this.height);
    drawGrid(pen, this);
    for (const sheet of this.below) sheet.draw(pen, this, settled);
    drawRobot(pen, this);
    this.above.draw(pen, this, settled);
    drawMarks(pen, this);
  },
  sx(x) { return (x - this.view.x) * this.view.scale + this.width / 2; },
  sy(y) { return (this.view.y - y) * this.view.scale + this.height / 2; },
  wx(sx) { return (sx - this.width / 2) / this.view.scale + this.view.x; },
  wy(sy) { return this.view.y - (sy - this.height / 2) / this.view.scale; },
  get dot() { return Math.max(this.leastDot, Math.min(6, 0.24 * this.spacing * this.view.scale)); },

  fit() {
    let [x0, x1, y0, y1] = [Infinity, -Infinity, Infinity, -Infinity];
    const take = (xs, ys) => {
      for (let i = 0; i < xs.length; i++) {
        if (xs[i] < x0) x0 = xs[i];
        if (xs[i] > x1) x1 = xs[i];
        if (ys[i] < y0) y0 = ys[i];
        if (ys[i] > y1) y1 = ys[i];
      }
    };
    take(run.place_x_m, run.place_y_m);
    take(run.row_x_m, run.row_y_m);
    if (x0 > x1) [x0, x1, y0, y1] = [-1, 1, -1, 1];
    const room = Math.min(56, this.width / 8);
    const scale = Math.min((this.width - 2 * room) / Math.max(x1 - x0, 0.1), (this.height - 2 * room - 26) / Math.max(y1 - y0, 0.1));
    this.view = { scale, x: (x0 + x1) / 2, y: (y0 + y1) / 2 - 13 / scale };
    this.smallest = scale / 8;
    this.largest = Math.max(scale * 4, 400 / this.spacing);
    this.draw();
  },
  pan(dx, dy) {
    this.view.x -= dx / this.view.scale;
    this.view.y += dy / this.view.scale;
    this.draw();
  },
  zoom(factor, sx = this.width / 2, sy = this.height / 2) {
    const x = this.wx(sx), y = this.wy(sy);
    this.view.scale = Math.max(this.smallest, Math.min(this.largest, this.view.scale * factor));
    this.view.x = x - (sx - this.width / 2) / this.view.scale;
    this.view.y = y + (sy - this.height / 2) / this.view.scale;
    this.draw();
    clearTimeout(this.settleTimer);
    this.settleTimer = setTimeout(() => this.paint(true), SETTLED_MS);
  },
  // Bring a point into the window if it is outside.
  show(x, y) {
    const sx = this.sx(x), sy = this.sy(y), edge = 60;
    if (sx < edge || sy < edge || sx > this.width - edge || sy > this.height - edge) {
      this.view.x = x;
      this.view.y = y;
    }
    this.draw();
  },
  nearest(sx, sy, within) {  // 5 000 experiences take some microseconds: no index is needed
    const x = this.wx(sx), y = this.wy(sy);
    let best = -1, least = (within / this.view.scale) ** 2;
    for (let i = 0; i < known.places; i++) {
      const dx = run.place_x_m[i] - x, dy = run.place_y_m[i] - y, square = dx * dx + dy * dy;
      if (square < least) { least = square; best = i; }
    }
    return best;
  },
};

function makeSheet(paintAll, paintOn) {
  const buffer = document.createElement("canvas");
  return {
    painted: null,
    draw(pen, window_, settled) {
      const { view, width, height } = window_, dpr = Math.min(2, devicePixelRatio || 1);
      const p = this.painted;
      let fits = p && p.dpr === dpr && p.width === width && p.height === height;
      if (fits) {
        const apart = (at, size) => Math.abs(at) * view.scale > SPARE * size;
        const out = apart(view.x - p.view.x, width) || apart(view.y - p.view.y, height);
        const zoomed = view.scale !== p.view.scale;
        if ((zoomed && (settled || p.cost < QUICK_MS)) || (out && !(zoomed && !settled))) fits = false;
      }
      const began = performance.now();
      if (!fits) {
        const w = width * (1 + 2 * SPARE), h = height * (1 + 2 * SPARE);
        const inside = fitCanvas(buffer, w, h);
        const at = { view: { ...view }, width: w, height: h, sx: map.sx, sy: map.sy };
        const dot = window_.dot;
        paintAll(inside, at, dot);
        this.painted = { view: at.view, at, dot, width, height, dpr, cost: performance.now() - began, row: chosen.row };
      } else if (paintOn && p.row !== chosen.row) {
        if (chosen.row < p.row) {
          fitCanvas(buffer, p.at.width, p.at.height);
          paintAll(buffer.getContext("2d"), p.at, p.dot);
        } else paintOn(buffer.getContext("2d"), p.at, p.dot, p.row);
        p.row = chosen.row;
      }
      const now = this.painted, zoom = view.scale / now.view.scale;
      const w = now.at.width * zoom, h = now.at.height * zoom;
      let x = width / 2 + (now.view.x - view.x) * view.scale - w / 2;
      let y = height / 2 - (now.view.y - view.y) * view.scale - h / 2;
      if (zoom === 1) { x = Math.round(x * dpr) / dpr; y = Math.round(y * dpr) / dpr; }
      pen.drawImage(buffer, x, y, w, h);
    },
  };
}

function line(pen, at, xs, ys, first = 0, last = xs.length - 1) {
  pen.beginPath();
  let down = false, px = 0, py = 0;
  for (let i = first; i <= last; i++) {
    const x = at.sx(xs[i]), y = at.sy(ys[i]);
    if (!(x === x)) { down = false; continue; }  // not on this map
    if (!down) pen.moveTo(x, y);
    else if (i < last && Math.abs(x - px) + Math.abs(y - py) < 1) continue;
    else pen.lineTo(x, y);
    down = true;
    px = x;
    py = y;
  }
  pen.stroke();
}

function paintStill(pen, at, dot) {
  pen.lineJoin = pen.lineCap = "round";
  if (layers.walls.on && run.wall_x_m && !about.cells.includes("pose")) drawWalls(pen, at);
  if (layers.landmarks.on && run.landmark_x_m) drawLandmarks(pen, at);
  if (layers.odometry.on) {
    pen.strokeStyle = colours.odometry;
    pen.lineWidth = 1;
    line(pen, at, run.row_odometry_x_m, run.row_odometry_y_m);
  }
  if (layers.truth.on && run.row_truth_x_m) {
    pen.strokeStyle = colours.truth;
    pen.setLineDash([5, 4]);
    pen.lineWidth = 1;
    line(pen, at, run.row_truth_x_m, run.row_truth_y_m);
    pen.setLineDash([]);
  }
  if (layers.whole.on) {
    pen.strokeStyle = colours.path;
    pen.globalAlpha = 0.35;
    pen.lineWidth = 1.2;
    line(pen, at, run.row_x_m, run.row_y_m);
    pen.globalAlpha = 1;
  }
  if (layers.links.on) drawLinks(pen, at, colours.link, 1, (i) => !run.link_loop[i]);
  pen.globalAlpha = 0.3;
  drawPlaces(pen, at, dot, known.byFirstRow);
  if (layers.loops.on) {
    pen.globalAlpha = 0.35;
    drawLoops(pen, at, dot, (i) => known.linkRow[i] >= 0);
  }
  pen.globalAlpha = 1;
  const before = [];  // experiences of earlier sessions that this run did not visit
  for (let i = 0; i < known.places; i++) if (known.firstRow[i] < 0) before.push(i);
  drawPlaces(pen, at, dot, before);
  if (layers.loops.on) drawLoops(pen, at, dot, (i) => known.linkRow[i] < 0);
}

// What the robot has seen, driven and closed up to the chosen row, from the row after `from` on.
const seenSince = (from) => {
  const seen = new Set();
  for (let i = Math.max(0, from); i <= chosen.row && i < known.rows; i++) if (run.row_place[i] >= 0) seen.add(run.row_place[i]);
  return seen;
};

function paintPlaces(pen, at, dot, from) { drawPlaces(pen, at, dot, seenSince(from)); }

function paintPath(pen, at, dot, from) {
  if (!layers.track.on || !known.rows) return;
  pen.lineJoin = pen.lineCap = "round";
  pen.strokeStyle = colours.path;
  pen.lineWidth = dot < 2 ? 1.2 : 2;
  line(pen, at, run.row_x_m, run.row_y_m, Math.max(0, from), chosen.row);
}

function paintLoops(pen, at, dot, from) {
  const made = (link) => known.linkRow[link] > from && known.linkRow[link] <= chosen.row;
  if (layers.loops.on) drawLoops(pen, at, dot, made);
}

function drawLinks(pen, at, colour, width, wanted) {
  pen.strokeStyle = colour;
  pen.lineWidth = width;
  pen.beginPath();
  for (let i = 0; i < known.links; i++) {
    if (!wanted(i)) continue;
    const a = run.link_from[i], b = run.link_to[i];
    pen.moveTo(at.sx(run.place_x_m[a]), at.sy(run.place_y_m[a]));
    pen.lineTo(at.sx(run.place_x_m[b]), at.sy(run.place_y_m[b]));
  }
  pen.stroke();
}

// Loop closures are often short: a ring marks the experience that was revisited.
function drawLoops(pen, at, dot, wanted) {
  drawLinks(pen, at, colours.loop, 1.6, (i) => run.link_loop[i] && wanted(i));
  const radius = Math.max(dot + 2.2, 3.2);
  pen.lineWidth = 1.3;
  pen.beginPath();
  for (const link of known.loops) {
    if (!wanted(link)) continue;
    const x = at.sx(run.place_x_m[run.link_to[link]]), y = at.sy(run.place_y_m[run.link_to[link]]);
    pen.moveTo(x + radius, y);
    pen.arc(x, y, radius, 0, 7);
  }
  pen.stroke();
}

// Bins of colours, so that experiences of one colour are drawn together.
function colourBins() {
  if (map.colouring === "session") return { of: (i) => run.place_session[i], colour: sessionColour };
  const values = {
    visits: (i) => Math.log2(1 + known.visits[i].length),
    seconds: (i) => Math.log2(1 + known.seconds[i]),
    since: (i) => Math.max(0, known.firstRow[i]),
  }[map.colouring];
  let top = 1e-9;
  for (let i = 0; i < known.places; i++) top = Math.max(top, values(i));
  return { of: (i) => Math.round((31 * values(i)) / top), colour: (bin) => rampColour(bin / 31) };
}

function drawPlaces(pen, at, dot, places) {
  const { of, colour } = map.bins ?? (map.bins = colourBins()), bins = new Map();
  for (const place of places) {
    const bin = of(place);
    if (!bins.has(bin)) bins.set(bin, []);
    bins.get(bin).push(place);
  }
  for (const [bin, inside] of bins) {
    pen.fillStyle = colour(bin);
    pen.beginPath();
    for (const place of inside) {
      const x = at.sx(run.place_x_m[place]), y = at.sy(run.place_y_m[place]);
      if (dot < 2) pen.rect(x - dot, y - dot, 2 * dot, 2 * dot);
      else { pen.moveTo(x + dot, y); pen.arc(x, y, dot, 0, 7); }
    }
    pen.fill();
  }
}

function drawLandmarks(pen, at) {
  pen.fillStyle = colours.landmark;
  pen.strokeStyle = colours.ink;
  pen.lineWidth = 0.8;
  for (let i = 0; i < run.landmark_x_m.length; i++) {
    const x = at.sx(run.landmark_x_m[i]), y = at.sy(run.landmark_y_m[i]);
    pen.beginPath();
    for (let k = 0; k < 10; k++) {  // a star
      const far = k % 2 ? 3 : 7, angle = (k / 5 - 0.5) * Math.PI;
      pen.lineTo(x + far * Math.cos(angle), y + far * Math.sin(angle));
    }
    pen.closePath();
    pen.fill();
    pen.stroke();
  }
  for (const one of about.words ?? []) drawWords(pen, at, one);
}

function drawWords(pen, at, one) {  // the name of a landmark, and the extent of a wall or region
  pen.strokeStyle = colours.landmark;
  pen.lineWidth = 3;
  pen.beginPath();
  for (const [x, y] of one.corners_m) pen.lineTo(at.sx(x), at.sy(y));
  if (one.kind === "region") pen.closePath();
  pen.stroke();
  pen.fillStyle = colours.ink;
  pen.font = "11px system-ui, sans-serif";
  const name = one.name.toLowerCase().replaceAll("_", " ");
  pen.fillText(name, at.sx(one.position_m[0]) + 9, at.sy(one.position_m[1]) + 4);
}

function drawWalls(pen, at) {
  const half = 0.05;  // metres: a part of a wall is stored as a point with a bearing
  pen.strokeStyle = colours.wall;
  pen.lineWidth = 3;
  pen.beginPath();
  for (let i = 0; i < run.wall_x_m.length; i++) {
    const dx = -Math.sin(run.wall_bearing_rad[i]) * half, dy = Math.cos(run.wall_bearing_rad[i]) * half;
    pen.moveTo(at.sx(run.wall_x_m[i] - dx), at.sy(run.wall_y_m[i] - dy));
    pen.lineTo(at.sx(run.wall_x_m[i] + dx), at.sy(run.wall_y_m[i] + dy));
  }
  pen.stroke();
}
