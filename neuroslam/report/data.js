"use strict";
// The data of the page and quantities derived from it: visits of experiences, loop closures.

const $ = (id) => document.getElementById(id);
const about = JSON.parse($("about").textContent);
const pictures = JSON.parse($("pictures").textContent);
const run = {};  // the arrays by name, filled by readArrays

async function readArrays() {
  const text = atob($("arrays").textContent);
  const packed = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) packed[i] = text.charCodeAt(i);
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = await new Response(stream).arrayBuffer();
  const kinds = { "<f4": Float32Array, "<f8": Float64Array, "<i4": Int32Array, "<u1": Uint8Array };
  for (const [name, [kind, shape, at]] of Object.entries(about.arrays)) {
    run[name] = new kinds[kind](bytes, at, shape.reduce((a, b) => a * b, 1));
    run[name].shape = shape;
  }
  $("arrays").remove();
  derive();
}

const known = {};  // quantities derived from the arrays

function derive() {
  known.rows = run.row_frame.length;
  known.places = run.place_x_m.length;
  known.links = run.link_from.length;
  const { rows, places, links } = known;
  known.firstRow = new Int32Array(places).fill(-1);
  known.visits = Array.from({ length: places }, () => []);  // pairs of first and last row
  known.seconds = new Float64Array(places);
  const transitions = new Map();  // first row of each transition between two experiences
  for (let row = 0, before = -1; row < rows; row++) {
    const place = run.row_place[row];
    if (place >= 0) {
      const visits = known.visits[place];
      if (known.firstRow[place] < 0) known.firstRow[place] = row;
      if (place === before) visits[visits.length - 1][1] = row;
      else visits.push([row, row]);
      if (row + 1 < rows) known.seconds[place] += run.row_time_s[row + 1] - run.row_time_s[row];
      if (before >= 0 && before !== place) {
        const key = before * places + place;
        if (!transitions.has(key)) transitions.set(key, row);
      }
    }
    before = place;
  }
  known.linkRow = new Int32Array(links).fill(-1);
  known.linksOf = Array.from({ length: places }, () => []);
  for (let link = 0; link < links; link++) {
    const from = run.link_from[link], to = run.link_to[link];
    const row = transitions.get(from * places + to) ?? transitions.get(to * places + from);
    if (row !== undefined) known.linkRow[link] = row;
    known.linksOf[from].push(link);
    known.linksOf[to].push(link);
  }
  known.loops = [];
  for (let link = 0; link < links; link++) if (run.link_loop[link]) known.loops.push(link);
  const when = (link) => (known.linkRow[link] < 0 ? Infinity : known.linkRow[link]);
  known.loops.sort((a, b) => when(a) - when(b) || a - b);
  known.byFirstRow = [...known.firstRow.keys()].filter((place) => known.firstRow[place] >= 0);
  known.byFirstRow.sort((a, b) => known.firstRow[a] - known.firstRow[b]);
  known.pictureRow = [];  // row and picture, in the order of rows
  for (let i = 0; i < run.picture_row.length; i += 2) {
    const row = rowOfFrame(run.picture_row[i]);
    if (rows && run.row_frame[row] === run.picture_row[i]) known.pictureRow.push([row, run.picture_row[i + 1]]);
  }
}

// Index of the last item that is not above a value, or 0.
function lastNotAbove(items, value, of = (item) => item) {
  let low = 0, high = items.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (of(items[middle]) <= value) low = middle;
    else high = middle - 1;
  }
  return low;
}

const rowOfFrame = (frame) => lastNotAbove(run.row_frame, frame);
const rowOfTime = (time) => lastNotAbove(run.row_time_s, time);

function pictureOfRow(row) {
  if (!known.pictureRow.length) return null;
  const found = known.pictureRow[lastNotAbove(known.pictureRow, row, (pair) => pair[0])];
  return { row: found[0], source: pictureSource(found[1]) };
}

const pictureSource = (number) => "data:image/webp;base64," + pictures[number];

// Seconds since the last visit of an experience before a row; null before its first visit.
function awaySeconds(place, row) {
  let last = null;
  for (const [, end] of known.visits[place]) {
    if (end >= row) break;
    last = end;
  }
  return last === null ? null : run.row_time_s[row] - run.row_time_s[last];
}

const isLost = (row) => about.lost.some(([first, last]) => row >= first && row <= last);

function make(tag, settings = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(settings)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name === "text") element.textContent = value;
    else if (name === "style") Object.assign(element.style, value);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) element.setAttribute(name, value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

const many = (n, noun) => `${n.toLocaleString("en")} ${noun}${n === 1 ? "" : "s"}`;
const metres = (m) => (about.unit !== "m" ? `${m.toFixed(2)} ${about.unit}` : Math.abs(m) < 1 ? `${(100 * m).toFixed(1)} cm` : `${m.toFixed(2)} m`);
const degrees = (rad) => `${((rad * 180) / Math.PI).toFixed(1)}°`;

function duration(s) {
  if (s < 100) return `${s.toFixed(1)} s`;
  const whole = Math.round(s), h = Math.floor(whole / 3600), m = Math.floor((whole % 3600) / 60);
  return h ? `${h} h ${m} min` : `${m} min ${whole % 60} s`;
}
