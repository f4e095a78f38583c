"use strict";
// Cells: path of the packet on the torus of the pose cells, activity at the end, place cells.

const TRAIL_S = 20;

function makePanel(title, note, paint, aspect, box = null) {
  const canvas = make("canvas", { role: "img", "aria-label": `${title}. ${note}` });
  const panel = {
    width: 0, seen: false,
    resize() {
      const width = canvas.clientWidth;
      if (width && width !== this.width) { this.width = width; this.paint(); }
    },
    follow() { if (this.seen) this.paint(); },
    paint() {
      if (!this.width) return;
      const height = this.width * aspect;
      canvas.style.height = `${height}px`;
      paint(fitCanvas(canvas, this.width, height), this.width, height);
    },
  };
  if (box) box.append(make("h3", { text: title }), canvas);
  else $("cell-panels").append(make("div", { class: "card" }, make("h3", { text: title }), make("p", { text: note }), canvas));
  new ResizeObserver(() => panel.resize()).observe(canvas);
  new IntersectionObserver(([entry]) => { panel.seen = entry.isIntersecting; panel.follow(); }).observe(canvas);
  watch("colours", () => panel.paint());
  return panel;
}

// Draws axes; returns functions from values to canvas coordinates.
function axes(pen, width, height, [x0, x1], [y0, y1], across, up) {
  const box = { left: 44, right: 12, top: 8, bottom: 34 };
  const x = (value) => box.left + ((value - x0) / (x1 - x0)) * (width - box.left - box.right);
  const y = (value) => height - box.bottom - ((value - y0) / (y1 - y0)) * (height - box.top - box.bottom);
  pen.strokeStyle = colours.line;
  pen.lineWidth = 1;
  pen.strokeRect(x(x0), y(y1), x(x1) - x(x0), y(y0) - y(y1));
  pen.fillStyle = colours.soft;
  pen.font = "11px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.textBaseline = "top";
  const ticksX = niceTicks(x0, x1, 5), ticksY = niceTicks(y0, y1, 5);
  for (const tick of ticksX.ticks) pen.fillText(tick.toFixed(ticksX.digits), x(tick), y(y0) + 4);
  pen.fillText(across, (x(x0) + x(x1)) / 2, y(y0) + 18);
  pen.textAlign = "right";
  pen.textBaseline = "middle";
  for (const tick of ticksY.ticks) pen.fillText(tick.toFixed(ticksY.digits), x(x0) - 5, y(tick));
  pen.save();
  pen.translate(9, (y(y0) + y(y1)) / 2);
  pen.rotate(-Math.PI / 2);
  pen.textAlign = "center";
  pen.fillText(up, 0, 0);
  pen.restore();
  return { x, y };
}

function paintTorus(pen, width, height) {
  const [n, nTheta] = about.torus, { x, y } = axes(pen, width, height, [0, n], [0, n], "x (cells)", "y (cells)");
  pen.strokeStyle = colours.faint;
  pen.beginPath();
  for (let i = 1; i < n; i++) { pen.moveTo(x(i), y(0)); pen.lineTo(x(i), y(n)); pen.moveTo(x(0), y(i)); pen.lineTo(x(n), y(i)); }
  pen.stroke();
  pen.fillStyle = colours.link;
  const size = known.places > 1500 ? 1.4 : 2.4;
  for (let i = 0; i < known.places; i++) {
    pen.fillRect(x(run.place_cell[3 * i]) - size / 2, y(run.place_cell[3 * i + 1]) - size / 2, size, size);
  }
  const end = chosen.row, first = rowOfTime(run.row_time_s[end] - TRAIL_S);
  pen.lineWidth = 2.5;
  pen.lineCap = "butt";
  pen.strokeStyle = colours.path;
  for (let i = first + 1, step = Math.max(1, (end - first) >> 9); i <= end; i += step) {
    const from = Math.max(first, i - step);
    const ax = run.row_pose_x[from], ay = run.row_pose_y[from], bx = run.row_pose_x[i], by = run.row_pose_y[i];
    if (Math.abs(ax - bx) > n / 2 || Math.abs(ay - by) > n / 2) continue;  // round the torus
    pen.globalAlpha = 0.08 + 0.92 * ((i - first) / Math.max(1, end - first)) ** 1.5;
    pen.beginPath();
    pen.moveTo(x(ax), y(ay));
    pen.lineTo(x(bx), y(by));
    pen.stroke();
  }
  pen.globalAlpha = 1;
  dart(pen, x(run.row_pose_x[end]), y(run.row_pose_y[end]), (2 * Math.PI * run.row_pose_theta[end]) / nTheta, colours.robot);
}

function heat(pen, box, values, rows, columns, most = 0) {
  const image = document.createElement("canvas");
  image.width = columns;
  image.height = rows;
  const ink = image.getContext("2d"), pixels = ink.createImageData(columns, rows);
  let top = most;
  if (!most) for (const value of values) top = Math.max(top, value);
  for (let r = 0; r < rows; r++) {
    for (let c = 0; c < columns; c++) {
      pixels.data.set([...ramp(values[r * columns + c] / (top || 1)), 255], 4 * ((rows - 1 - r) * columns + c));
    }
  }
  ink.putImageData(pixels, 0, 0);
  pen.imageSmoothingEnabled = false;
  pen.drawImage(image, box.x0, box.y0, box.x1 - box.x0, box.y1 - box.y0);
  return top;
}

function paintActivity(pen, width, whole) {
  const height = whole - 30, [n, nTheta] = about.torus, half = width / 2;
  const place = axes(pen, half, height, [0, n], [0, n], "x (cells)", "y (cells)");
  const most = heat(pen, { x0: place.x(0), x1: place.x(n), y0: place.y(n), y1: place.y(0) }, run.activity_xy, n, n);
  pen.save();
  pen.translate(half, 0);
  const heading = axes(pen, half, height, [0, n], [0, 360], "x (cells)", "heading θ (°)");
  heat(pen, { x0: heading.x(0), x1: heading.x(n), y0: heading.y(360), y1: heading.y(0) }, run.activity_theta_x, nTheta, n, most);
  pen.restore();
  const bar = pen.createLinearGradient(60, 0, 220, 0);
  RAMP.forEach((rgb, i) => bar.addColorStop(i / (RAMP.length - 1), `rgb(${rgb})`));
  pen.fillStyle = bar;
  pen.fillRect(60, whole - 20, 160, 9);
  pen.fillStyle = colours.soft;
  pen.textBaseline = "middle";
  pen.textAlign = "right";
  pen.fillText("0", 54, whole - 15);
  pen.textAlign = "left";
  pen.fillText(`${most.toFixed(3)} of all activity`, 226, whole - 15);
}

function paintPlaceCells(pen, width, height) {
  const xs = run.cell_x_m, ys = run.cell_y_m;
  let [x0, x1, y0, y1] = [Infinity, -Infinity, Infinity, -Infinity];
  for (const [across, up] of [[xs, ys], [run.wall_x_m, run.wall_y_m]]) {
    for (let i = 0; i < across.length; i++) {
      x0 = Math.min(x0, across[i]); x1 = Math.max(x1, across[i]);
      y0 = Math.min(y0, up[i]); y1 = Math.max(y1, up[i]);
    }
  }
  if (x0 > x1) [x0, x1, y0, y1] = [-1, 1, -1, 1];
  const inner = [width - 56, height - 42], span = 1.08 * Math.max((x1 - x0) / inner[0], (y1 - y0) / inner[1], 1e-3);
  const cx = (x0 + x1) / 2, cy = (y0 + y1) / 2;
  const { x, y } = axes(pen, width, height, [cx - (span * inner[0]) / 2, cx + (span * inner[0]) / 2],
    [cy - (span * inner[1]) / 2, cy + (span * inner[1]) / 2], `x (${about.unit})`, `y (${about.unit})`);
  drawWalls(pen, { sx: x, sy: y });
  pen.strokeStyle = colours.link;
  pen.lineWidth = 0.8;
  pen.beginPath();
  for (let i = 0; i < run.cell_links.length; i += 2) {
    const a = run.cell_links[i], b = run.cell_links[i + 1];
    pen.moveTo(x(xs[a]), y(ys[a]));
    pen.lineTo(x(xs[b]), y(ys[b]));
  }
  pen.stroke();
  let top = 1e-9;
  for (const seconds of run.cell_time_s) top = Math.max(top, Math.log2(1 + seconds));
  const radius = Math.max(1.2, Math.min(5, 60 / Math.sqrt(xs.length)));
  for (let i = 0; i < xs.length; i++) {
    pen.fillStyle = rampColour(Math.log2(1 + run.cell_time_s[i]) / top);
    pen.beginPath();
    pen.arc(x(xs[i]), y(ys[i]), radius, 0, 7);
    pen.fill();
  }
}

function startCells() {
  if (about.cells.includes("pose")) {
    if (known.rows) {
      const note = `Path of the packet over the torus in the last ${TRAIL_S} s; the arrow is its heading. Opposite edges are neighbours. Dots: bindings of experiences.`;
      const panels = [makePanel("Packet of the pose cells", note, paintTorus, 0.95), makePanel("Pose cells, the last " + TRAIL_S + " s", note, paintTorus, 0.95, $("now-cells"))];
      watch("row", () => panels.forEach((panel) => panel.follow()));
    }
    makePanel("Activity at the end of the run", "Left summed over heading, right over y; yellow is the peak. A run stores only the final activity.", paintActivity, 0.62);
  }
  if (about.cells.includes("place")) {
    const cells = run.cell_x_m.length, walls = run.wall_x_m.length;
    let longest = 0;
    for (const seconds of run.cell_time_s) longest = Math.max(longest, seconds);
    makePanel("Place cells", `${many(cells, "place cell")}, coloured by the time spent there (yellow: ${duration(longest)}); grey: ${many(walls, "remembered part")} of walls.`, paintPlaceCells, 0.9);
  }
}
