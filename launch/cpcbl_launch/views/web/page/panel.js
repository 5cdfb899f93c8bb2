// The table of all robots, which also serves screen readers, and all of the chosen one.
const $ = (id) => document.getElementById(id);
const number = (value, digits = 3) => (value == null ? "–" : value.toFixed(digits));
const plural = (n, what) => `${n} ${what}${n === 1 ? "" : "s"}`;
const words = (name) => name.replaceAll("_", " ");

export class Panel {
  constructor(team, robots, choose, openCamera) {
    Object.assign(this, { team, robots, choose, openCamera, rows: new Map() });
    this.body = document.querySelector("#robots tbody");
    $("close").onclick = () => { const row = this.rows.get(team.chosen); choose(team.chosen); row?.button.focus(); };
    $("camera").onclick = () => this.setCamera(!this.isCameraOpen);
  }

  get isCameraOpen() {
    return $("camera").getAttribute("aria-pressed") === "true";
  }

  clear() {
    this.rows.clear();
    this.body.replaceChildren();
  }

  draw() {
    const names = [...this.robots.keys()];
    for (const name of this.rows.keys()) if (!this.robots.has(name)) { this.removeRow(name); }
    for (const name of names) this.drawRow(this.robots.get(name));
  }

  drawRow(r) {
    if (!this.rows.has(r.name)) this.addRow(r.name);
    const { row, reason, button, cells } = this.rows.get(r.name), state = r.state ?? "waiting";
    for (const line of [row, reason]) line.classList.toggle("chosen", r.name === this.team.chosen);
    row.dataset.state = state;
    button.setAttribute("aria-pressed", r.name === this.team.chosen);
    button.style.setProperty("--own", r.colour);
    set(button, r.is_guest ? `${r.name} (guest)` : r.name);
    set(cells[0], state);
    cells[0].className = `s-${state}`;
    const words = [state === "ok" ? "" : r.why, r.frame && `in frame ${r.frame}`].filter(Boolean).join("; ");
    reason.hidden = !words;
    set(reason.firstChild, words);
    reason.firstChild.className = `s-${state}`;
    const isThere = state !== "gone" && state !== "waiting";
    [isThere ? r.tier ?? "–" : "–", isThere ? number(r.sigma_m) : "–", isThere ? number(r.error_m) : "–", isThere ? r.sees.length : "–"].forEach((v, i) => set(cells[i + 1], String(v)));
  }

  addRow(name) {
    const row = document.createElement("tr"), first = document.createElement("td"), button = document.createElement("button");
    button.type = "button";
    first.append(button);
    const cells = Array.from({ length: 5 }, () => document.createElement("td"));
    cells[3].className = "truth";
    row.append(first, ...cells);
    const reason = document.createElement("tr"), words = document.createElement("td");
    words.colSpan = 6;
    reason.className = "why";
    reason.append(words);
    row.onclick = reason.onclick = () => this.choose(name);
    row.dataset.robot = name;
    const next = [...this.rows.keys()].filter((other) => other > name).sort()[0];
    const before = next ? this.rows.get(next).row : null;
    this.body.insertBefore(row, before);
    this.body.insertBefore(reason, before);
    this.rows.set(name, { row, reason, button, cells });
  }

  removeRow(name) {
    const { row, reason } = this.rows.get(name);
    row.remove();
    reason.remove();
    this.rows.delete(name);
  }

  show(name) {
    const has = this.team.cameras === null || this.team.cameras.includes(name);
    this.setCamera(false);
    $("detail").hidden = !name;
    $("hint").hidden = !!name;
    $("camera").hidden = !has;
    set($("detail-name"), name);
    $("facts").replaceChildren(name ? paragraph("Waiting for its status, which it sends once a second.") : "");
    this.draw();
    if (name && innerWidth <= 820) $("detail").scrollIntoView({ block: "nearest" });
  }

  setCamera(isOpen) {
    if (isOpen === this.isCameraOpen) return;
    $("camera").setAttribute("aria-pressed", isOpen);
    $("picture").hidden = true;
    this.openCamera(isOpen);
  }

  showPicture(camera, blob) {
    if (!camera || camera.robot !== this.team.chosen || !this.isCameraOpen) return;
    const image = $("picture").querySelector("img"), before = image.src;
    image.src = URL.createObjectURL(new Blob([blob], { type: "image/jpeg" }));
    if (before) URL.revokeObjectURL(before);
    const told = camera.found.length ? `sees ${camera.found.join(", ")}` : "sees nothing that it knows";
    image.alt = `Camera of ${camera.robot}: ${told}`;
    set($("picture").querySelector("figcaption"), camera.no.length ? `${told}; rejected: ${camera.no.map(words).join(", ")}` : told);
    $("picture").hidden = false;
  }

  showDetail(d) {
    if (d.robot !== this.team.chosen) return;
    if (!d.process) return;
    const r = this.robots.get(d.robot), parts = [];
    if (r?.why && !d.problems.includes(r.why)) parts.push(paragraph(`${r.state}: ${r.why}`, `s-${r.state}`));
    if (d.problems.length) parts.push(heading("Problems"), list(d.problems));
    const place = r?.pose ? `x ${number(r.pose[0], 2)} m, y ${number(r.pose[1], 2)} m, heading ${((r.pose[2] * 180) / Math.PI).toFixed(0)}°` : "no pose";
    parts.push(heading("Pose"), paragraph(`${place}; heading σ ${number(d.heading_sigma_deg, 1)}°; sees ${r?.sees?.map((s) => s[0]).join(", ") || "nothing"}`));
    parts.push(heading("Inputs"), this.inputs(d));
    const refused = Object.entries(d.refused).sort((a, b) => b[1] - a[1]);
    parts.push(heading("Refused"), refused.length ? grid([], refused.map(([why, n]) => [words(why), n])) : paragraph("nothing", "none"));
    parts.push(heading("Gives help to"), flows(d.sent, "all who listen"));
    parts.push(heading("Gets help from"), flows(d.heard, ""));
    parts.push(heading("Budget"), budget(d.spending));
    parts.push(heading("Trust"), trust(d.trust));
    parts.push(counts(d.counts));
    const all = $("facts").querySelector("details"), hasFocus = all?.contains(document.activeElement);
    parts.at(-1).open = !!all?.open;
    $("facts").replaceChildren(...parts);
    if (hasFocus) parts.at(-1).firstChild.focus();
  }

  inputs(d) {
    if (d.inputs.length) {
      const seconds = (s) => (s === null ? "–" : Math.abs(s) < 100 ? `${s.toFixed(2)} s` : s > 0 ? "> 100 s" : "< −100 s");
      const rows = d.inputs.flatMap((i) => {
        const refused = Object.entries(i.refused), all = refused.reduce((sum, [, n]) => sum + n, 0);
        const row = [i.input, `${i.rate_hz} Hz`, seconds(i.age_s), seconds(i.offset_s), i.taken, all];
        return all ? [row, [refused.map(([why, n]) => `${words(why)} ${n}`).join(", ")]] : [row];
      });
      return grid(["", "rate", "age", "late by", "taken", "refused"], rows);
    }
    const known = ["odometry", "sightings", "position", "frame", "accepted", "gated"].filter((k) => d.counts[k]);
    return known.length ? grid([], known.map((k) => [{ accepted: "measurements used", gated: "measurements rejected" }[k] ?? k, d.counts[k]])) : paragraph("nothing was taken yet", "warn");
  }
}

function flows(all, everybody) {
  const rows = all.filter((f) => f.topic !== "alive" && f.messages + f.over_budget + f.worthless + f.silent).map((f) => [`${f.peer || everybody} (${f.topic})`, f.at_present ? `${number(f.messages_per_s, 1)}/s` : "–", f.messages, f.over_budget + f.worthless + f.silent]);
  return rows.length ? grid(["", "now", "messages", "not sent"], rows) : paragraph("nobody", "none");
}

function budget(spending) {
  if (!spending.length) return paragraph("no limit", "none");
  return grid([], spending.map((s) => {
    const meter = document.createElement("meter"), span = s.window_s ? `in ${s.window_s} s` : "in the match";
    Object.assign(meter, { min: 0, max: Math.max(s.allowed, 1e-9), value: s.most, title: `${s.most} of ${s.allowed}` });
    return [`${s.unit} ${span}`, `${Math.round(s.most)} of ${Math.round(s.allowed)}`, meter];
  }));
}

function trust(all) {
  if (!all.length) return paragraph("it hears no teammate", "none");
  return list(all.map((t) => {
    const times = t.quarantines ? `; in quarantine ${plural(t.quarantines, "time")} so far` : "";
    return `${t.peer}: ${t.reason ? `not used, ${t.reason}` : t.unconfirmed ? "used, but no other source can confirm it" : "used"}${times}`;
  }));
}

function counts(all) {
  const details = document.createElement("details"), summary = document.createElement("summary");
  summary.textContent = "All counts since its start";
  details.append(summary, grid([], Object.entries(all).sort().map(([what, n]) => [words(what), n])));
  return details;
}

function grid(head, rows) {
  const table = document.createElement("table");
  if (head.length) table.createTHead().append(line("th", head));
  const body = table.createTBody();
  rows.forEach((row) => body.append(line("td", row)));
  return table;
}

function line(kind, cells) {
  const row = document.createElement("tr");
  for (const cell of cells) {
    const made = document.createElement(kind);
    if (cells.length === 1) Object.assign(made, { colSpan: 6, className: "warn" }); // what is refused, below its input
    made.append(cell instanceof Node ? cell : String(cell));
    row.append(made);
  }
  return row;
}

function list(lines) {
  const made = document.createElement("ul");
  for (const text of lines) { const item = document.createElement("li"); item.textContent = text; made.append(item); }
  return made;
}

function heading(text) {
  const made = document.createElement("h3");
  made.textContent = text;
  return made;
}

function paragraph(text, kind = "") {
  const made = document.createElement("p");
  made.textContent = text;
  made.className = kind;
  return made;
}

function set(element, text) {
  if (element.textContent !== text) element.textContent = text;
}
