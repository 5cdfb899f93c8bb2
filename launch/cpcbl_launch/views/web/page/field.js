// The map: metres to pixels, pointers and keys, and everything that is drawn on it.
import { ink } from "./colours.js";

const STEPS = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000];
const SMALL = 600; // pixels of a map

export class FieldMap {
  constructor(canvas, team, robots, choose, redraw) {
    Object.assign(this, { canvas, team, robots, choose, redraw });
    this.context = canvas.getContext("2d");
    this.scale = 80;
    this.x = this.y = 0; // the middle of the picture, in metres
    this.isFitted = true; // until a person moves it
    this.pointers = new Map();
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.listen();
  }

  resize() {
    const { clientWidth: w, clientHeight: h } = this.canvas, ratio = devicePixelRatio || 1;
    this.canvas.width = Math.round(w * ratio);
    this.canvas.height = Math.round(h * ratio);
    Object.assign(this, { w, h, ratio });
    this.redraw();
  }

  // Moving and zooming ---------------------------------------------------------------------------

  listen() {
    const { canvas, pointers } = this, at = (id) => document.getElementById(id);
    canvas.addEventListener("pointerdown", (e) => {
      canvas.setPointerCapture(e.pointerId);
      pointers.set(e.pointerId, [e.offsetX, e.offsetY]);
      if (pointers.size === 1) this.travel = 0;
    });
    canvas.addEventListener("pointermove", (e) => this.drag(e));
    canvas.addEventListener("pointerup", (e) => {
      if (pointers.size === 1 && this.travel < 6) this.choose(this.robotAt(e.offsetX, e.offsetY));
      pointers.delete(e.pointerId);
    });
    canvas.addEventListener("pointercancel", (e) => pointers.delete(e.pointerId));
    canvas.addEventListener("wheel", (e) => {
      e.preventDefault();
      this.zoom(Math.exp(-e.deltaY * (e.deltaMode ? 0.05 : 0.0015)), e.offsetX, e.offsetY);
    }, { passive: false });
    canvas.addEventListener("keydown", (e) => {
      const step = 60, act = {
        ArrowLeft: () => this.pan(step, 0), ArrowRight: () => this.pan(-step, 0),
        ArrowUp: () => this.pan(0, step), ArrowDown: () => this.pan(0, -step),
        "+": () => this.zoom(1.25), "=": () => this.zoom(1.25), "-": () => this.zoom(0.8),
        0: () => this.fit(), Escape: () => this.choose(this.team.chosen),
      }[e.key];
      if (act && !e.ctrlKey && !e.metaKey) { e.preventDefault(); act(); }
    });
    at("zoom-in").onclick = () => this.zoom(1.4);
    at("zoom-out").onclick = () => this.zoom(1 / 1.4);
    at("fit").onclick = () => this.fit();
  }

  drag(e) {
    const { pointers } = this, before = pointers.get(e.pointerId);
    if (!before) return;
    const now = [e.offsetX, e.offsetY], other = [...pointers].find(([id]) => id !== e.pointerId)?.[1];
    pointers.set(e.pointerId, now);
    this.travel += Math.hypot(now[0] - before[0], now[1] - before[1]);
    if (this.travel < 6) return;
    if (!other) return void this.pan(now[0] - before[0], now[1] - before[1]);
    const spread = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
    this.pan((now[0] - before[0]) / 2, (now[1] - before[1]) / 2);
    this.zoom(spread(now) / Math.max(1, spread(before)), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
  }

  pan(dx, dy) {
    this.isFitted = false;
    this.x -= dx / this.scale;
    this.y += dy / this.scale;
    this.redraw();
  }

  zoom(factor, px = this.w / 2, py = this.h / 2) {
    const [x, y] = this.metres(px, py);
    this.isFitted = false;
    this.scale = Math.min(5000, Math.max(0.2, this.scale * factor));
    const [nx, ny] = this.metres(px, py);
    this.x += x - nx;
    this.y += y - ny;
    this.redraw();
  }

  fit() {
    this.isFitted = true;
    this.redraw();
  }

  // The map and all robots near it: one that is lost may believe to be anywhere.
  frameAll() {
    const { landmarks, walls } = this.team;
    let points = landmarks.map(([, x, y]) => [x, y]);
    for (const r of this.robots.values()) for (const [, x, y] of r.places ?? []) points.push([x, y]);
    for (const [, x1, y1, x2, y2] of walls) points.push([x1, y1], [x2, y2]);
    const box = (all) => [Math.min, Math.max].map((f) => [0, 1].map((i) => all.reduce((v, p) => f(v, p[i]), all[0][i])));
    const poses = [...this.robots.values()].filter((r) => r.pose).map((r) => r.pose);
    if (points.length) {
      const [[x0, y0], [x1, y1]] = box(points), far = Math.max(x1 - x0, y1 - y0, 2);
      points = points.concat(poses.filter(([x, y]) => x > x0 - far && x < x1 + far && y > y0 - far && y < y1 + far));
    } else {
      const known = [...this.robots.values()].filter((r) => r.pose && r.state !== "lost").map((r) => r.pose);
      points = known.length ? known : poses;
    }
    if (!points.length) return;
    const [[x0, y0], [x1, y1]] = box(points), space = Math.min(48, this.w * 0.1);
    const tools = document.querySelector(".tools"), right = this.w < SMALL ? Math.max(space, tools.offsetWidth + 16) : space; // no mark below the buttons
    const wide = Math.max(x1 - x0, 1), high = Math.max(y1 - y0, 1);
    const scale = Math.min((this.w - space - right) / wide, (this.h - 2 * space) / high, 2000);
    if (scale > 0) Object.assign(this, { scale, x: (x0 + x1) / 2 + (right - space) / (2 * scale), y: (y0 + y1) / 2 });
  }

  pixels(x, y) {
    return [this.w / 2 + (x - this.x) * this.scale, this.h / 2 - (y - this.y) * this.scale];
  }

  metres(px, py) {
    return [this.x + (px - this.w / 2) / this.scale, this.y - (py - this.h / 2) / this.scale];
  }

  robotAt(px, py) {
    let best = "", nearest = 26;
    for (const r of this.robots.values()) {
      if (!r.pose) continue;
      const [x, y] = this.pixels(r.pose[0], r.pose[1]), far = Math.hypot(x - px, y - py);
      if (far < nearest) [best, nearest] = [r.name, far];
    }
    return best || this.team.chosen; // beside all robots: none is chosen any more
  }

  // Drawing --------------------------------------------------------------------------------------

  draw() {
    if (!this.w) return;
    if (this.isFitted) this.frameAll();
    const c = this.context;
    c.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    c.fillStyle = ink("field");
    c.fillRect(0, 0, this.w, this.h);
    c.lineJoin = c.lineCap = "round";
    this.drawGrid();
    this.drawMap();
    const all = [...this.robots.values()].filter((r) => r.pose), { chosen } = this.team;
    this.isCrowded = all.length > 12;
    this.size = this.isCrowded ? 7 : 11;
    this.isPlain = all.length > 60; // without what takes long to draw
    const strength = (r) => (!chosen || r.name === chosen ? 1 : 0.5);
    for (const r of all) this.drawTrail(r, strength(r));
    for (const r of all) this.drawPlaces(r, strength(r));
    for (const r of all) this.drawEllipse(r, strength(r));
    for (const r of all) this.drawSightings(r, strength(r));
    for (const r of all) this.drawTruth(r);
    for (const arrow of this.team.help) this.drawHelp(arrow);
    for (const r of all) this.drawRobot(r);
    this.taken = [];
    const rank = (r) => (r.name === chosen ? 0 : r.state === "lost" || r.state === "gone" ? 1 : 2);
    for (const r of all.sort((a, b) => rank(a) - rank(b))) this.drawName(r);
    c.globalAlpha = 1;
    this.drawScale();
  }

  path(points) {
    this.context.beginPath();
    for (const [x, y] of points) this.context.lineTo(x, y);
  }

  drawGrid() {
    const c = this.context, step = this.gridStep = STEPS.find((s) => s * this.scale >= 45) ?? 1000;
    const [left, top] = this.metres(0, 0), [right, bottom] = this.metres(this.w, this.h);
    c.strokeStyle = ink("grid");
    c.lineWidth = 1;
    c.beginPath();
    for (let x = Math.ceil(left / step) * step; x <= right; x += step) {
      const [px] = this.pixels(x, 0);
      c.moveTo(px, 0); c.lineTo(px, this.h);
    }
    for (let y = Math.ceil(bottom / step) * step; y <= top; y += step) {
      const [, py] = this.pixels(0, y);
      c.moveTo(0, py); c.lineTo(this.w, py);
    }
    c.stroke();
  }

  drawScale() {
    const c = this.context, wide = this.gridStep * this.scale, y = this.h - 14;
    c.strokeStyle = c.fillStyle = ink("soft");
    c.lineWidth = 2;
    this.path([[12, y - 4], [12, y], [12 + wide, y], [12 + wide, y - 4]]);
    c.stroke();
    this.text(`${this.gridStep} m`, 18 + wide, y + 1, "left", 12, "soft");
  }

  text(words, x, y, align, size, colour, weight = "") {
    const c = this.context;
    c.font = `${weight} ${size}px system-ui, sans-serif`;
    c.textAlign = align;
    c.lineWidth = 3;
    c.strokeStyle = ink("field");
    c.strokeText(words, x, y);
    c.fillStyle = ink(colour);
    c.fillText(words, x, y);
  }

  drawMap() {
    const c = this.context;
    c.strokeStyle = ink("mark");
    c.lineWidth = 4;
    for (const [, x1, y1, x2, y2] of this.team.walls) {
      this.path([this.pixels(x1, y1), this.pixels(x2, y2)]);
      c.stroke();
    }
    for (const [name, x, y] of this.team.landmarks) {
      const [px, py] = this.pixels(x, y), r = 6;
      c.fillStyle = ink("mark");
      this.path([[px, py - r], [px + r, py], [px, py + r], [px - r, py]]);
      c.fill();
      if (this.team.landmarks.length <= 24) this.text(name, px, py + 20, "center", 12, "soft");
    }
  }

  drawTrail(r, strength) {
    if (r.trail.length < 2) return;
    const c = this.context;
    c.strokeStyle = r.state === "gone" ? ink("gone") : r.colour;
    c.lineWidth = 1.5;
    const trail = this.isPlain ? r.trail.filter((_, i) => i % 5 === 0) : r.trail;
    const points = trail.map(([, x, y]) => this.pixels(x, y)), n = points.length;
    for (let part = this.isPlain ? 3 : 0; part < 4; part += 1) { // it fades
      const from = Math.floor((part * n) / 4), until = Math.floor(((part + 1) * n) / 4) + 1;
      c.globalAlpha = strength * (0.15 + 0.15 * part);
      this.path(points.slice(from, until));
      c.stroke();
    }
  }

  drawEllipse(r, strength) {
    if (!r.ellipse || r.state === "gone") return;
    const c = this.context, [px, py] = this.pixels(r.pose[0], r.pose[1]);
    const [a, b, angle] = r.ellipse, limit = 20 * (this.w + this.h);
    c.beginPath();
    c.ellipse(px, py, Math.min(3 * a * this.scale, limit), Math.min(3 * b * this.scale, limit), -angle, 0, 2 * Math.PI);
    c.fillStyle = c.strokeStyle = r.state === "lost" ? ink("lost") : r.colour;
    c.globalAlpha = (3 * a * this.scale > this.w / 4 ? 0.03 : 0.13) * strength; // one that is lost would colour everything
    c.fill();
    c.globalAlpha = 0.8 * strength;
    c.lineWidth = 1.2;
    c.stroke();
  }

  // Landmarks that the robot finds itself, with the ellipses of 3 σ.
  drawPlaces(r, strength) {
    if (this.isCrowded && r.name !== this.team.chosen) return;
    const c = this.context, isNamed = r.name === this.team.chosen || this.robots.size === 1;
    c.strokeStyle = r.colour;
    for (const [name, x, y, a, b, angle] of r.places ?? []) {
      const [px, py] = this.pixels(x, y), size = 5, limit = 20 * (this.w + this.h);
      c.globalAlpha = 0.9 * strength;
      c.lineWidth = 1.5;
      this.path([[px, py - size], [px + size, py], [px, py + size], [px - size, py], [px, py - size]]);
      c.stroke();
      c.globalAlpha = 0.5 * strength;
      c.lineWidth = 1;
      c.beginPath();
      c.ellipse(px, py, Math.min(3 * a * this.scale, limit), Math.min(3 * b * this.scale, limit), -angle, 0, 2 * Math.PI);
      c.stroke();
      if (isNamed) this.text(name, px, py + 18, "center", 11, "soft");
    }
  }

  // A sighting without a range goes as far as what is seen; one without a bearing has no direction.
  drawSightings(r, strength) {
    if (this.isCrowded && r.name !== this.team.chosen) return;
    const c = this.context, [x, y, heading] = r.pose, from = this.pixels(x, y);
    c.strokeStyle = c.fillStyle = r.colour;
    c.lineWidth = 1;
    for (const [what, range, bearing] of r.sees) {
      const there = this.placeOf(what);
      const far = range ?? (there ? Math.hypot(there[0] - x, there[1] - y) : 1);
      const turned = bearing !== null ? heading + bearing : there ? Math.atan2(there[1] - y, there[0] - x) : null;
      if (turned === null) continue;
      const [px, py] = this.pixels(x + far * Math.cos(turned), y + far * Math.sin(turned));
      c.globalAlpha = 0.38 * strength;
      this.path([from, [px, py]]);
      c.stroke();
      c.globalAlpha = 0.8 * strength;
      c.beginPath();
      c.arc(px, py, 2.5, 0, 2 * Math.PI);
      c.fill();
    }
  }

  placeOf(name) {
    const mark = this.team.landmarks.find((l) => l[0] === name);
    return mark ? mark.slice(1) : this.robots.get(name)?.pose ?? this.foundPlaceOf(name);
  }

  foundPlaceOf(name) {
    for (const r of this.robots.values()) {
      const found = r.places?.find((place) => place[0] === name);
      if (found) return found.slice(1, 3);
    }
    return null;
  }

  drawTruth(r) {
    if (!r.truth) return;
    const c = this.context, [x, y, heading] = r.truth, [px, py] = this.pixels(x, y);
    c.globalAlpha = 1;
    c.strokeStyle = ink("truth");
    c.lineWidth = 1.5;
    this.outline(px, py, heading, this.size + 2);
    c.stroke();
  }

  outline(px, py, heading, size) {
    const at = (d, a) => [px + d * Math.cos(a - heading), py + d * Math.sin(a - heading)];
    this.path([at(size + 4, 0), at(size, 2.45), at(size * 0.4, Math.PI), at(size, -2.45)]);
    this.context.closePath();
  }

  drawHelp([helper, helped, topic, tier, rate]) {
    const from = this.robots.get(helper), to = this.robots.get(helped), { chosen } = this.team;
    if (!from?.pose || !to?.pose) return;
    const mine = chosen === helper || chosen === helped;
    if (chosen && !mine && this.isCrowded) return;
    const c = this.context, a = this.pixels(from.pose[0], from.pose[1]), b = this.pixels(to.pose[0], to.pose[1]);
    const dx = b[0] - a[0], dy = b[1] - a[1], far = Math.hypot(dx, dy);
    if (far < 3 * this.size) return;
    const bow = topic === "fix" ? 0.16 : 0.26; // both kinds beside each other
    const mid = [(a[0] + b[0]) / 2 - dy * bow, (a[1] + b[1]) / 2 + dx * bow];
    const into = Math.atan2(b[1] - mid[1], b[0] - mid[0]), out = Math.atan2(mid[1] - a[1], mid[0] - a[0]);
    const gap = this.size + 5, tip = [b[0] - gap * Math.cos(into), b[1] - gap * Math.sin(into)];
    c.strokeStyle = c.fillStyle = from.colour;
    c.globalAlpha = (chosen && !mine ? 0.4 : 0.95) * Math.max(0.4, 1 - tier / 20) * (this.isCrowded && !chosen ? 0.5 : 1);
    c.lineWidth = (this.isCrowded ? 1 : 1.6) + Math.min(2, Math.log10(1 + (rate ?? 0)));
    c.setLineDash(topic === "fix" || this.isPlain ? [] : [7, 5]);
    c.beginPath();
    c.moveTo(a[0] + gap * Math.cos(out), a[1] + gap * Math.sin(out));
    c.quadraticCurveTo(mid[0], mid[1], tip[0] - 6 * Math.cos(into), tip[1] - 6 * Math.sin(into));
    c.stroke();
    c.setLineDash([]);
    const head = this.isCrowded ? 7 : 12;
    this.path([0, 2.65, -2.65].map((turn) => (turn ? [tip[0] + head * Math.cos(into + turn), tip[1] + head * Math.sin(into + turn)] : tip)));
    c.fill();
  }

  drawRobot(r) {
    const c = this.context, [px, py] = this.pixels(r.pose[0], r.pose[1]), { size } = this;
    c.globalAlpha = 1;
    if (r.name === this.team.chosen) {
      c.strokeStyle = ink("focus");
      c.lineWidth = 2.5;
      c.beginPath();
      c.arc(px, py, size + 9, 0, 2 * Math.PI);
      c.stroke();
    }
    if (r.state === "gone") {
      c.strokeStyle = ink("gone");
      c.lineWidth = 4;
      for (const s of [1, -1]) { this.path([[px - 7, py - 7 * s], [px + 7, py + 7 * s]]); c.stroke(); }
      return;
    }
    const isLost = r.state === "lost";
    c.fillStyle = isLost ? ink("lost") : r.colour;
    c.strokeStyle = ink("field");
    c.lineWidth = 2;
    if (isLost) { // with a mark: red alone is not for everybody
      c.beginPath();
      c.arc(px, py, size, 0, 2 * Math.PI);
      c.fill();
      c.stroke();
      c.font = `bold ${size + 4}px system-ui, sans-serif`;
      c.textAlign = "center";
      c.fillStyle = ink("panel");
      c.fillText("!", px, py + size / 2);
      return;
    }
    this.outline(px, py, r.pose[2], size);
    c.stroke();
    c.fill();
  }

  drawName(r) {
    const { chosen } = this.team, words = r.state === "gone" ? `${r.name}, gone` : r.tier === null ? r.name : `${r.name} · ${r.tier}`;
    const [px, py] = this.pixels(r.pose[0], r.pose[1]), c = this.context;
    if (px < -50 || py < -20 || px > this.w + 50 || py > this.h + 20) return;
    const height = this.isCrowded ? 11 : 13, far = this.size + 10;
    c.font = `600 ${height}px system-ui, sans-serif`;
    const wide = c.measureText(words).width + 4;
    const place = [[0, -far], [0, far + 10], [far + wide / 2, 5], [-far - wide / 2, 5]].find(([dx, dy]) => this.isFree(px + dx - wide / 2, py + dy - 11, wide, 15));
    if (!place && this.isCrowded && r.name !== chosen) return;
    const [dx, dy] = place ?? [0, -far], colour = { lost: "lost", gone: "gone" }[r.state] ?? "ink";
    this.taken.push([px + dx - wide / 2, py + dy - 11, wide, 15]);
    c.globalAlpha = chosen && chosen !== r.name && r.state !== "lost" ? 0.75 : 1;
    this.text(words, px + dx, py + dy, "center", height, colour, "600");
    if (r.state === "lost" && !this.isCrowded && (this.w > 500 || r.name === chosen)) this.text(`lost: ${r.why.split("; ")[0]}`, px + dx, py + dy + (dy < 0 ? -16 : 16), "center", 12, "lost");
    c.globalAlpha = 1;
  }

  isFree(x, y, w, h) {
    return !this.taken.some(([a, b, c, d]) => x < a + c && a < x + w && y < b + d && b < y + h);
  }
}
