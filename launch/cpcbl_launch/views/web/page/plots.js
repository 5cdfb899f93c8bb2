// Lines over time on a logarithmic scale: one a robot, with its name at its end.
import { ink } from "./colours.js";

const MARGIN = { left: 44, right: 84, top: 6, bottom: 20 };

export class Plot {
  constructor(canvas, robots, team, column, least) {
    Object.assign(this, { canvas, robots, team, column, least }); // column of a sample: 3 sigma, 4 error
    this.context = canvas.getContext("2d");
  }

  draw(now, span) {
    const { canvas, context: c, column, team } = this, w = canvas.clientWidth, h = canvas.clientHeight;
    if (!w || !h) return;
    const ratio = devicePixelRatio || 1;
    if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
      canvas.width = Math.round(w * ratio);
      canvas.height = Math.round(h * ratio);
    }
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, w, h);
    const lines = [...this.robots.values()].map((r) => ({ r, rows: r.samples.filter((s) => s[column] != null && now - s[0] <= span) })).filter((l) => l.rows.length);
    const values = lines.flatMap((l) => l.rows.map((s) => Math.max(s[column], this.least)));
    const from = values.reduce((a, b) => Math.min(a, b), 0.1), until = values.reduce((a, b) => Math.max(a, b), 0.1);
    const low = Math.floor(Math.log10(from)), high = Math.max(low + 1, Math.ceil(Math.log10(until)));
    const right = lines.length ? MARGIN.right : 12;
    const x = (at) => w - right - ((now - at) / span) * (w - right - MARGIN.left);
    const y = (v) => h - MARGIN.bottom - ((Math.log10(Math.max(v, this.least)) - low) / (high - low)) * (h - MARGIN.bottom - MARGIN.top);
    this.drawAxes({ c, x, y, low, high, now, span, w, h, right });
    c.save();
    c.beginPath();
    c.rect(MARGIN.left, 0, w - MARGIN.left - right + 2, h);
    c.clip();
    for (const { r, rows } of lines) this.drawLine(c, x, y, r, rows, column);
    c.restore();
    this.drawNames(c, y, lines, w - right + 6, h, column, team.chosen);
  }

  drawAxes({ c, x, y, low, high, now, span, w, h, right }) {
    c.font = "11px system-ui, sans-serif";
    c.lineWidth = 1;
    c.fillStyle = ink("soft");
    c.textAlign = "right";
    for (let power = low; power <= high; power += 1) {
      const at = y(10 ** power);
      c.strokeStyle = ink("grid");
      c.beginPath(); c.moveTo(MARGIN.left, at); c.lineTo(w - right, at); c.stroke();
      c.fillText(String(+(10 ** power).toFixed(4)), MARGIN.left - 6, at + 4);
    }
    c.textAlign = "center";
    for (let s = 0; s <= span; s += 15) c.fillText(s ? `−${s} s` : "now", x(now - s), h - 5);
  }

  drawLine(c, x, y, r, rows, column) {
    const { chosen } = this.team;
    c.strokeStyle = r.state === "lost" ? ink("lost") : r.state === "gone" ? ink("gone") : r.colour;
    const isCrowded = this.robots.size > 12;
    c.globalAlpha = chosen === r.name ? 1 : (chosen ? 0.3 : 0.95) * (isCrowded && r.state !== "lost" ? 0.45 : 1);
    c.lineWidth = chosen === r.name ? 2.5 : isCrowded ? 0.9 : 1.6;
    c.beginPath();
    let before = null;
    for (const s of rows) {
      if (before === null || s[0] - before > 2) c.moveTo(x(s[0]), y(s[column]));
      else c.lineTo(x(s[0]), y(s[column]));
      before = s[0];
    }
    c.stroke();
    c.globalAlpha = 1;
  }

  drawNames(c, y, lines, left, h, column, chosen) {
    const fits = Math.floor((h - 8) / 13);
    let named = lines.map(({ r, rows }) => ({ r, at: y(rows.at(-1)[column]) })).sort((a, b) => a.at - b.at);
    if (named.length > fits) named = named.filter(({ r }, i) => r.name === chosen || i === 0 || i === named.length - 1);
    let floor = 8;
    for (const label of named) { label.at = Math.max(label.at, floor); floor = label.at + 13; }
    let ceiling = h - 6;
    for (const label of named.toReversed()) { label.at = Math.min(label.at, ceiling); ceiling = label.at - 13; }
    c.textAlign = "left";
    for (const { r, at } of named) {
      c.font = `${chosen === r.name ? "bold " : ""}12px system-ui, sans-serif`;
      c.fillStyle = r.state === "lost" ? ink("lost") : r.colour;
      c.globalAlpha = !chosen || chosen === r.name ? 1 : 0.5;
      c.fillText(r.name, left, at + 4, MARGIN.right - 8);
    }
    c.globalAlpha = 1;
  }
}
