"use strict";
// The selection, its watchers, and the colours.

const chosen = { row: 0, place: -1, link: -1, playing: false };
const watchers = { row: [], place: [], link: [], colours: [] };
const watch = (what, then) => watchers[what].push(then);
const notify = (what) => watchers[what].forEach((then) => then());

function chooseRow(row) {
  row = Math.max(0, Math.min(known.rows - 1, Math.round(row)));
  if (row === chosen.row || !known.rows) return;
  chosen.row = row;
  notify("row");
}

function choosePlace(place, show = true) {
  chosen.place = place;
  if (place >= 0) {
    chosen.link = -1;
    if (show) map.show(run.place_x_m[place], run.place_y_m[place]);
    $("said").textContent = `Experience ${place}, ${many(known.visits[place].length, "visit")}`;
    showTab("place");
  }
  notify("place");
}

function chooseLink(link) {
  chosen.link = link;
  chosen.place = -1;
  const from = run.link_from[link], to = run.link_to[link];
  if (known.linkRow[link] >= 0) chooseRow(known.linkRow[link]);
  map.show((run.place_x_m[from] + run.place_x_m[to]) / 2, (run.place_y_m[from] + run.place_y_m[to]) / 2);
  $("said").textContent = `Loop closure from experience ${from} to ${to}`;
  notify("place");
  notify("link");
}

const colours = {};
const SESSIONS = ["map", "second", "third", "fourth", "fifth", "sixth"];

function readColours() {
  const style = getComputedStyle(document.documentElement);
  for (const name of ["panel", "ink", "soft", "line", "faint", "accent", "loop", "robot", "path",
    "odometry", "truth", "link", "wall", "landmark", "match", "plan", "lost", ...SESSIONS]) {
    colours[name] = style.getPropertyValue(`--${name}`).trim();
  }
  notify("colours");
}

const sessionColour = (session) => colours[SESSIONS[session % SESSIONS.length]];

function setTheme(theme) {
  document.documentElement.dataset.theme = theme;
  readColours();
}

const prefersDark = matchMedia("(prefers-color-scheme: dark)");
document.documentElement.dataset.theme = prefersDark.matches ? "dark" : "light";
prefersDark.addEventListener("change", () => setTheme(prefersDark.matches ? "dark" : "light"));
$("theme").addEventListener("click", () =>
  setTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark"));
let beforePrint = null;
addEventListener("beforeprint", () => {
  beforePrint = document.documentElement.dataset.theme;
  setTheme("light");
});
addEventListener("afterprint", () => setTheme(beforePrint));

// Viridis at nine points, as in the package's figures.
const RAMP = [[68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141],
  [39, 173, 129], [92, 200, 99], [170, 220, 50], [253, 231, 37]];

function ramp(share) {
  const at = Math.max(0, Math.min(1, share)) * (RAMP.length - 1), low = Math.min(RAMP.length - 2, Math.floor(at));
  return RAMP[low].map((from, i) => Math.round(from + (at - low) * (RAMP[low + 1][i] - from)));
}

const rampColour = (share) => `rgb(${ramp(share).join(",")})`;
const rampStyle = `linear-gradient(to right, ${RAMP.map((rgb) => `rgb(${rgb})`).join(",")})`;

// Fit a canvas to its box on the page, in device pixels.
function fitCanvas(canvas, width, height) {
  const dpr = Math.min(2, devicePixelRatio || 1);
  const w = Math.max(1, Math.round(width * dpr)), h = Math.max(1, Math.round(height * dpr));
  if (canvas.width !== w || canvas.height !== h) {
    canvas.width = w;
    canvas.height = h;
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(dpr, 0, 0, dpr, 0, 0);
  pen.clearRect(0, 0, width, height);
  return pen;
}

// Round numbers from low to high, about `n` of them.
function niceTicks(low, high, n) {
  const span = high - low || 1, raw = span / Math.max(1, n), power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].find((factor) => factor * power >= raw) * power;
  const ticks = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * span; i++) ticks.push(i * step);
  return { ticks, digits: Math.max(0, -Math.floor(Math.log10(step) + 1e-9)) };
}
