// Plays a measured drive back beside what a model predicts of it, with traces and residuals.
import { clamp } from "./maths.js";
import { unpack } from "./shapes.js";

const INK = "#e8eaed", MODEL = "#56b4e9", RULE = "#3a4149", MUTED = "#aab2bb";
const HIGH = 62, LOW = 34, GAP = 6, LEFT = 46, WIDE = 330, MOST_SIGMA = 6, PACES = [1, 2, 5, 10], STEP = 2, STALE = 0.3;

const byId = (id) => document.getElementById(id);
const made = (tag, parent, more = {}) => parent.appendChild(Object.assign(document.createElement(tag), more));

// Bodies of a rover at any time, between the frames.
class Course {
  constructor(text, times) {
    this.values = unpack(text, Float32Array);
    this.times = times;
    this.count = this.values.length / times.length / 7;
  }

  at(time) {
    const { times, values, count } = this, last = times.length - 1;
    const place = clamp((time - times[0]) / (times[last] - times[0]), 0, 1) * last;
    const i = Math.min(Math.floor(place), last - 1), share = place - i, bodies = [];
    for (let b = 0; b < count; b++) {
      const p = 7 * (i * count + b), q = p + 7 * count, body = [];
      let same = 0;
      for (let k = 3; k < 7; k++) same += values[p + k] * values[q + k];
      for (let k = 0; k < 7; k++) {
        const sign = k > 2 && same < 0 ? -1 : 1;   // the shorter way between two attitudes
        body.push((1 - share) * values[p + k] + share * sign * values[q + k]);
      }
      const length = Math.hypot(...body.slice(3)) || 1;
      bodies.push([...body.slice(0, 3), ...body.slice(3).map((v) => v / length)]);
    }
    return bodies;
  }
}

const extent = (lists) => {
  let low = Infinity, high = -Infinity;
  for (const list of lists) for (const v of list) if (v !== null) { low = Math.min(low, v); high = Math.max(high, v); }
  const spare = 0.06 * (high - low) || 1;
  return [low - spare, high + spare];
};
// An end of an axis, with as many digits as its span needs: both ends alike.
const end = (v, span) => (span >= 1e5 ? v.toExponential(1) : v.toFixed(clamp(2 - Math.ceil(Math.log10(span)), 0, 6))).replace("-", "−");

class Plot {
  constructor(parent, trace, span) {
    Object.assign(this, { trace, span });
    this.box = made("figure", parent);
    const caption = made("figcaption", this.box);
    made("span", caption, { textContent: trace.label });
    this.now = made("output", caption);
    this.canvas = made("canvas", this.box);
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", `${trace.label}: measured as dots, the model as a line, and the residual below`);
    this.cursor = made("i", this.box, { className: "cursor" });
  }

  x(time) { return LEFT + (WIDE - LEFT - 4) * (time - this.span[0]) / (this.span[1] - this.span[0]); }

  draw(model) {
    this.model = model;
    const { canvas, trace } = this, ratio = Math.min(window.devicePixelRatio || 1, 2), height = HIGH + GAP + LOW;
    canvas.width = WIDE * ratio;
    canvas.height = height * ratio;
    const pen = canvas.getContext("2d");
    pen.scale(ratio, ratio);
    pen.font = "10px system-ui, sans-serif";
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    const predicted = trace.predicted[model], residual = trace.residual[model];
    const [low, high] = extent([trace.measured, ...trace.predicted]);
    const y = (v) => HIGH - HIGH * (v - low) / (high - low);
    const zero = HIGH + GAP + LOW / 2, sigma = (v) => zero - LOW / 2 * clamp(v / MOST_SIGMA, -1, 1);
    pen.fillStyle = MUTED;
    pen.fillText(end(high, high - low), LEFT - 4, 6);
    pen.fillText(end(low, high - low), LEFT - 4, HIGH - 6);
    pen.fillText("residual", LEFT - 4, zero);
    pen.strokeStyle = RULE;
    pen.strokeRect(LEFT, 0.5, WIDE - LEFT - 4, HIGH - 1);
    for (const v of [-2, 0, 2]) {
      pen.setLineDash(v ? [3, 3] : []);
      pen.beginPath(); pen.moveTo(LEFT, sigma(v)); pen.lineTo(WIDE - 4, sigma(v)); pen.stroke();
    }
    pen.setLineDash([]);
    const usual = (this.span[1] - this.span[0]) / Math.max(trace.time.length - 1, 1);
    pen.strokeStyle = MODEL;
    pen.lineWidth = 1.6;
    pen.beginPath();
    let before = null;
    trace.time.forEach((time, i) => {
      if (predicted[i] === null) { before = null; return; }
      if (before === null || time - before > 5 * usual) pen.moveTo(this.x(time), y(predicted[i]));
      else pen.lineTo(this.x(time), y(predicted[i]));
      before = time;
    });
    pen.stroke();
    pen.fillStyle = INK;
    trace.time.forEach((time, i) => trace.measured[i] !== null && pen.fillRect(this.x(time) - 0.8, y(trace.measured[i]) - 0.8, 1.6, 1.6));
    pen.strokeStyle = "#e69f00";
    pen.lineWidth = 1;
    pen.beginPath();
    trace.time.forEach((time, i) => {
      if (residual[i] === null) return;
      pen.moveTo(this.x(time), zero);
      pen.lineTo(this.x(time), sigma(residual[i]));
    });
    pen.stroke();
  }

  show(time) {
    const times = this.trace.time;
    let i = 0, far = times.length - 1;
    while (far - i > 1) { const mid = (i + far) >> 1; if (times[mid] <= time) i = mid; else far = mid; }
    if (Math.abs(times[far] - time) < Math.abs(times[i] - time)) i = far;
    const value = this.trace.residual[this.model][i];
    this.cursor.style.left = `${this.x(clamp(time, ...this.span))}px`;
    this.now.textContent = value === null ? "–" : `${value < 0 ? "−" : "+"}${Math.abs(value).toFixed(1)} σ`;
  }
}

export class Replay {
  constructor(scene, view, onCamera) {
    const { replay } = scene, times = replay.time;
    Object.assign(this, { scene, view, times, time: times[0], playing: true, pace: 0, model: replay.models.length - 1, dust: [] });
    document.body.classList.add("replaying");
    byId("replay").hidden = byId("player").hidden = false;
    byId("replay-title").textContent = replay.title;
    byId("help").textContent = "Space plays and pauses, the arrow keys go back and forth, R begins anew, C changes the camera. " +
      "Drag to look around, scroll to come nearer.";
    this.measured = new Course(replay.measured, times);
    this.models = replay.models.map((m) => new Course(m.bodies, times));
    const choice = byId("model");
    replay.models.forEach((m) => made("option", choice, { textContent: m.label }));
    choice.selectedIndex = this.model;
    choice.addEventListener("change", () => this.choose(choice.selectedIndex));
    const span = [times[0], times.at(-1)];
    this.plots = replay.traces.map((trace) => new Plot(byId("plots"), trace, span));
    const when = byId("when");
    [when.min, when.max] = span;
    when.addEventListener("input", () => this.seek(Number(when.value)));
    byId("play").addEventListener("click", () => this.toggle());
    byId("pace").addEventListener("click", () => {
      this.pace = (this.pace + 1) % PACES.length;
      byId("pace").textContent = `${PACES[this.pace]} ×`;
    });
    byId("camera").addEventListener("click", onCamera);
    const keys = { Space: () => this.toggle(), ArrowLeft: () => this.seek(this.time - STEP), ArrowRight: () => this.seek(this.time + STEP),
      KeyR: () => this.seek(span[0]), KeyC: onCamera };
    addEventListener("keydown", (event) => {
      // a button, a list or a slider that has the focus keeps its own keys
      if (event.ctrlKey || event.metaKey || event.altKey || /^(SELECT|INPUT|BUTTON)$/.test(event.target.tagName) || !keys[event.code]) return;
      keys[event.code]();
      event.preventDefault();
    });
    this.choose(this.model);
  }

  choose(model) {
    Object.assign(this, { model, dust: [] });
    this.plots.forEach((plot) => plot.draw(model));
    this.show();
  }

  toggle() {
    if (!this.playing && this.time >= this.times.at(-1)) this.seek(this.times[0]);
    this.playing = !this.playing;
    byId("play").textContent = this.playing ? "pause" : "play";
  }

  seek(time) {
    this.time = clamp(time, this.times[0], this.times.at(-1));
    this.view?.restart();
    this.dust = [];
    this.show();
  }

  tick(seconds) {
    if (!this.playing) return;
    this.time = Math.min(this.time + seconds * PACES[this.pace], this.times.at(-1));
    if (this.time >= this.times.at(-1)) this.toggle();
    this.show();
  }

  // Asks for the dust of the time that is shown, once the answer before is there; what is out of date is asked for anew.
  async fetchDust() {
    if (!this.scene.replay.dusty || !this.view || this.asking) return;
    const { time, model } = this;
    this.asking = true;
    try {
      const answer = await fetch(`/dust?time=${time}&model=${model}`);
      const dust = answer.ok ? await answer.json() : [];
      const late = model !== this.model || Math.abs(time - this.time) > STALE * PACES[this.pace];
      this.dust = this.view.dust = late ? [] : dust;
      document.body.dataset.grains = this.dust.length / 5;
    } catch {
      return;   // the server has ended
    } finally {
      this.asking = false;
    }
    if (!this.playing && (time !== this.time || model !== this.model)) this.fetchDust();
  }

  show() {
    const measured = this.measured.at(this.time), ghost = this.models[this.model].at(this.time), body = this.scene.chassis;
    this.view?.show(measured, { ghost, dust: this.dust });
    this.fetchDust();
    const gap = Math.hypot(ghost[body][0] - measured[body][0], ghost[body][1] - measured[body][1]);
    byId("gap").textContent = `The model is ${gap.toFixed(2)} m away from where the rover was.`;
    const part = this.scene.replay.parts.findLast((p) => p.begin <= this.time + 1e-6);
    if (part) byId("replay-title").textContent = part.title;
    byId("clock").textContent = `${(this.time - this.times[0]).toFixed(1)} of ${(this.times.at(-1) - this.times[0]).toFixed(1)} s`;
    byId("when").value = this.time;
    this.plots.forEach((plot) => plot.show(this.time));
    document.body.dataset.time = this.time.toFixed(3);
  }
}
