// The connection, the state of all robots, and who draws it when.
import { forgetInks, ink } from "./colours.js";
import { FieldMap } from "./field.js";
import { Panel } from "./panel.js";
import { Player } from "./player.js";
import { Plot } from "./plots.js";

const TRAIL_S = 30, PLOT_S = 60, SLOW_MS = 500, LEFT_OUT_MS = 5000;
const $ = (id) => document.getElementById(id);

export const team = { name: "", landmarks: [], walls: [], cameras: null, help: [], at: 0, chosen: "" };
export const robots = new Map(); // name -> {name, colour, trail, samples, ...what the server sent}
// For tests and benchmarks
globalThis.viewStats = { frames: 0, poses: 0, drawn: 0, firstPictureMs: null, longestGapMs: 0, skipped: 0, lastMs: null, drawMs: 0, scale: 0 };
const stats = globalThis.viewStats;

const leftOut = []; // [when, how many frames] of late
let socket = null, retryMs = 500, camera = null, due = false, slowDue = 0;
const choose = (name) => {
  team.chosen = name === team.chosen ? "" : name;
  panel.show(team.chosen);
  say({ robot: team.chosen });
  redraw();
};
const map = new FieldMap($("map"), team, robots, choose, () => redraw());
const panel = new Panel(team, robots, choose, (open) => say({ camera: open }));
const player = new Player((request) => say(request));
stats.marks = () => team.landmarks.map(([, x, y]) => map.pixels(x, y));
const plots = [new Plot($("sigma"), robots, team, 3, 1e-4), new Plot($("error"), robots, team, 4, 1e-3)];

function say(request) {
  if (socket && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(request));
}

function connect() {
  socket = new WebSocket(`ws://${location.host}/live`);
  socket.binaryType = "blob";
  socket.onmessage = ({ data }) => (typeof data === "string" ? take(JSON.parse(data)) : panel.showPicture(camera, data));
  socket.onopen = () => { retryMs = 500; };
  socket.onclose = () => {
    setLink(false);
    notice("The view does not answer: it has ended, it has as many pages as it takes, or the network is down. This page tries again by itself.");
    setTimeout(connect, retryMs);
    retryMs = Math.min(2 * retryMs, 5000);
  };
}

function take(message) {
  if (message.type === "team") start(message);
  else if (message.type === "frame") frame(message);
  else if (message.type === "detail") panel.showDetail(message);
  else if (message.type === "camera") camera = message;
}

function start(message) {
  const isSame = team.name === message.team; // after a jump, or the connection is back
  Object.assign(team, { name: message.team, landmarks: message.landmarks, walls: message.walls, cameras: message.cameras, help: [] });
  robots.clear();
  stats.lastMs = null;
  for (const [name, rows] of Object.entries(message.history)) {
    robot(name).samples = rows;
    robot(name).trail = rows.map(([at, x, y]) => [at, x, y]);
  }
  $("team").textContent = team.name;
  document.title = `${team.name} · cpcbl-team view`;
  player.start(message.recording);
  if (!isSame) {
    panel.clear();
    map.fit();
  }
  if (team.chosen) say({ robot: team.chosen, camera: panel.isCameraOpen });
}

function robot(name) {
  if (!robots.has(name)) robots.set(name, { name, trail: [], samples: [] });
  return robots.get(name);
}

// What the server leaves out has its default.
const DEFAULTS = { severity: "good", why: "", is_guest: false, at_s: null, pose: null, ellipse: null, sigma_m: null, error_m: null, tier: null, truth: null, sees: [], places: [], frame: "" };

function frame(message) {
  say({ ack: message.number });
  team.at = message.at_s;
  for (const [name, picture] of Object.entries(message.robots)) {
    const known = robot(name), before = known.at_s;
    Object.assign(known, DEFAULTS, picture);
    if (known.pose && known.at_s !== before) {
      addSample(known);
      stats.poses += 1;
    }
  }
  for (const name of message.removed) robots.delete(name);
  if (message.help) team.help = message.help;
  player.show(message.at_s, message.play);
  notice(message.notice);
  const now = performance.now();
  if (message.skipped > stats.skipped) leftOut.push([now, message.skipped - stats.skipped]);
  while (leftOut.length && now - leftOut[0][0] > LEFT_OUT_MS) leftOut.shift();
  stats.skipped = message.skipped;
  setLink(true);
  if (stats.lastMs !== null) stats.longestGapMs = Math.max(stats.longestGapMs, now - stats.lastMs);
  stats.lastMs = now;
  stats.frames += 1;
  redraw();
}

function addSample(known) {
  const [x, y] = known.pose, at = known.at_s, last = known.trail.at(-1);
  if (!last || Math.hypot(x - last[1], y - last[2]) > 0.01 || at - last[0] > 1) known.trail.push([at, x, y]);
  while (known.trail.length && at - known.trail[0][0] > TRAIL_S) known.trail.shift();
  if (!known.samples.length || at - known.samples.at(-1)[0] > (robots.size > 20 ? 0.45 : 0.18)) known.samples.push([at, x, y, known.sigma_m, known.error_m]);
  while (known.samples.length && at - known.samples[0][0] > PLOT_S + 5) known.samples.shift();
}

function redraw() {
  if (due) return;
  due = true;
  requestAnimationFrame(draw);
}

function draw() {
  due = false;
  const from = performance.now();
  colour();
  map.draw();
  stats.drawn += 1;
  stats.scale = map.scale;
  if (stats.firstPictureMs === null && [...robots.values()].some((r) => r.pose)) stats.firstPictureMs = performance.now();
  if (from >= slowDue) { // what nobody reads ten times a second
    const isTrue = [...robots.values()].some((r) => r.error_m != null);
    document.body.classList.toggle("no-truth", !isTrue);
    panel.draw();
    plots.forEach((plot) => plot.draw(team.at, PLOT_S));
    summary();
    const now = performance.now();
    slowDue = now + Math.max(SLOW_MS, 5 * (now - from)); // a slow device draws it less often
  }
  stats.drawMs = Math.max(stats.drawMs, performance.now() - from);
}

// Each robot keeps its colour while the others stay the same; red is for lost ones alone.
function colour() {
  [...robots.keys()].sort().forEach((name, i) => { robots.get(name).colour = ink(`r${i % 7}`); });
}

function summary() {
  const count = { ok: 0, unconfirmed: 0, problem: 0, lost: 0, gone: 0, waiting: 0 };
  for (const { state } of robots.values()) count[state ?? "waiting"] += 1;
  const total = robots.size, words = [`${total} ${total === 1 ? "robot" : "robots"}`];
  if (count.problem) words.push(`${count.problem} with a problem`);
  if (count.unconfirmed) words.push(`${count.unconfirmed} unconfirmed`);
  if (count.lost) words.push(`${count.lost} lost`);
  if (count.gone) words.push(`${count.gone} gone`);
  if (count.waiting) words.push(`${count.waiting} waiting`);
  if (total && count.ok === total) words.push("all well");
  setText($("summary"), words.join(", "));
  $("summary").classList.toggle("bad", [...robots.values()].some((r) => r.severity === "error"));
}

function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

function notice(text) {
  $("notice").hidden = !text;
  setText($("notice"), text);
}

function setLink(isLive) {
  const kind = player.recording ? "recording" : "live";
  $("link").classList.toggle("live", isLive);
  const recent = leftOut.filter(([at]) => performance.now() - at < LEFT_OUT_MS).reduce((n, [, more]) => n + more, 0);
  setText($("link"), !isLive ? "not connected" : recent ? `${kind}, ${recent} ${recent === 1 ? "frame" : "frames"} left out` : kind);
}

matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { forgetInks(); redraw(); });
$("legend").open = innerWidth > 820;
connect();
