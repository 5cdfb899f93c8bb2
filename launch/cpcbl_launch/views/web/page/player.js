// The controls of a recording: play, pause, a slider for the time, the speed.
const $ = (id) => document.getElementById(id);
const JUMP_MS = 120; // between two wishes of a slider that is dragged

export class Player {
  constructor(say) {
    Object.assign(this, { say, recording: null, isPlaying: false, isDragged: false, due: 0 });
    $("play").onclick = () => this.toggle();
    $("speed").onchange = () => say({ speed: +$("speed").value });
    $("seek").oninput = () => { this.isDragged = true; this.write(+$("seek").value); this.jumpSoon(); };
    $("seek").onchange = () => { this.isDragged = false; this.jump(); };
    document.addEventListener("keydown", (e) => {
      const isFree = !e.target.closest("button, input, select, summary, a");
      if (this.recording && isFree && e.key === " ") { e.preventDefault(); this.toggle(); }
    });
  }

  toggle() {
    this.say({ play: !this.isPlaying });
  }

  start(recording) {
    this.recording = recording;
    $("player").hidden = !recording;
    if (recording) $("seek").max = recording.duration_s;
  }

  show(at, play) {
    if (!this.recording || !play) return;
    const [speed, isPlaying] = play, options = [...$("speed").options];
    this.isPlaying = isPlaying;
    const words = isPlaying ? "Pause" : "Play";
    if ($("play").textContent !== words) $("play").textContent = words;
    if (document.activeElement !== $("speed")) $("speed").value = options.find((o) => +o.value === speed)?.value ?? "1";
    if (this.isDragged || this.due) return;
    $("seek").value = at;
    this.write(at);
  }

  jumpSoon() {
    this.due ||= setTimeout(() => this.jump(), JUMP_MS);
  }

  jump() {
    clearTimeout(this.due);
    this.due = 0;
    this.say({ at_s: +$("seek").value });
  }

  write(at) {
    const { duration_s: all, begin_s: begin } = this.recording, text = `${clock(at)} of ${clock(all)}`;
    const date = begin > 1e9 ? new Date((begin + at) * 1000).toLocaleTimeString() : "";
    $("seek").setAttribute("aria-valuetext", text);
    $("time").textContent = text;
    if (date) $("time").append(Object.assign(document.createElement("span"), { className: "date", textContent: ` (${date})` }));
  }
}

function clock(seconds) {
  const whole = Math.floor(seconds), two = (n) => String(n).padStart(2, "0");
  const [h, m, s] = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60, whole % 60];
  return h ? `${h}:${two(m)}:${two(s)}` : `${m}:${two(s)}`;
}
