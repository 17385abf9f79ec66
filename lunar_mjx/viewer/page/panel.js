// The readings as text and bars, and the keys.
import { clamp } from "./maths.js";

const byId = (id) => document.getElementById(id);
const number = (v, digits) =>
  v === null ? "–" : (Number(v.toFixed(digits)) || 0).toFixed(digits).replace("-", "−");   // no minus before zero

const WORDS = { lf: "left front", rf: "right front", lm: "left middle", rm: "right middle", lr: "left rear",
  rr: "right rear", sus: "suspension" };

// A joint's name in words: "rf_sus" is the right front suspension.
const spoken = (joint) => joint.split("_").map((part) => WORDS[part] ?? part).join(" ");

export class Panel {
  constructor(scene) {
    byId("title").textContent = `${scene.rover} on ${scene.terrain}` + (scene.driver ? `, driven by ${scene.driver}` : "");
    document.body.classList.toggle("driven", Boolean(scene.driver));
    if (scene.driver) byId("help").textContent = "R begins another episode, C changes the camera. Drag to look around, " +
      "scroll to come nearer.";
    document.title = `${scene.rover} – lunar-mjx view`;
    const table = document.createElement("table");
    const head = table.createTHead().insertRow();
    for (const text of ["wheel", "slip ratio", "sinkage", "winding"]) {
      const cell = document.createElement("th");
      cell.textContent = text;
      cell.scope = "col";
      head.append(cell);
    }
    // the bars' scale: braked and locked, rolling freely, spinning on the spot
    const scale = table.tHead.insertRow(), ticks = document.createElement("div");
    scale.className = "scale";
    scale.insertCell();
    scale.insertCell().append(ticks);
    ticks.title = "-1: locked, 0: rolling without slip, 1: spinning on the spot";
    for (const text of ["−1", "0", "1"]) ticks.append(Object.assign(document.createElement("span"), { textContent: text }));
    const body = table.createTBody();
    this.rows = scene.wheels.map((wheel) => {
      const row = body.insertRow();
      row.dataset.wheel = wheel.corner;
      const [name, slip, sinkage, winding] = [0, 1, 2, 3].map(() => row.insertCell());
      name.textContent = WORDS[wheel.corner] ?? wheel.corner;
      name.title = wheel.corner;
      const bar = document.createElement("span"), fill = document.createElement("i"), text = document.createElement("span");
      bar.className = "bar";
      bar.append(fill);
      slip.append(bar, text);
      return { bar, fill, text, sinkage, winding };
    });
    byId("wheels").append(table);
  }

  show(now) {
    byId("time").textContent = `${number(now.time_s, 1)} s` + (now.rate < 0.9 ? `, ${number(now.rate, 2)} × real time` : "");
    byId("speed").textContent = `${number(now.speed_m_s, 2)} m/s`;
    byId("path").textContent = `${number(now.path_m, 1)} m`;
    byId("heading").textContent = `${number(Math.round(now.heading_deg) % 360, 0)}°`;
    byId("pitch").textContent = `${number(-now.pitch_deg, 1)}°`;
    byId("roll").textContent = `${number(now.roll_deg, 1)}°`;
    byId("goal").textContent = now.goal ? `${number(now.goal_m, 1)} m away` : "";
    byId("power").textContent = `${number(now.power_W, 0)} W`;
    byId("hottest").textContent = `${spoken(now.hottest)} ${number(now.hottest_degC, 1)} °C`;
    this.rows.forEach((row, i) => {
      const slip = clamp(now.slip[i] ?? 0, -1, 1);
      row.fill.style.left = `${slip < 0 ? 50 + 50 * slip : 50}%`;
      row.fill.style.width = `${50 * Math.abs(slip)}%`;
      row.bar.classList.toggle("high", Math.abs(slip) > 0.5);
      row.text.textContent = number(now.slip[i], 2);
      row.sinkage.textContent = `${number(now.sinkage_mm[i], 1)} mm`;
      row.winding.textContent = `${number(now.winding_degC[i], 1)} °C`;
    });
    this.note(now.note);
  }

  note(text) {
    byId("note").hidden = !text;
    byId("note").textContent = text;
  }
}

const KEYS = { ArrowUp: "forward", KeyW: "forward", ArrowDown: "back", KeyS: "back", ArrowLeft: "left", KeyA: "left",
  ArrowRight: "right", KeyD: "right", Space: "brake" };

// Tells the server which keys are held, at every change and three times a second while some are.
export function listen(onReset, onCamera) {
  const held = new Map();   // what holds it -> key
  const send = (path, body) => fetch(path, { method: "POST", headers: { "Content-Type": "application/json" },
    body: JSON.stringify(body) }).catch(() => {});
  const tell = () => {
    const keys = [...new Set(held.values())];
    document.querySelectorAll("[data-key]").forEach((b) => b.classList.toggle("held", keys.includes(b.dataset.key)));
    send("/keys", { held: keys });
  };
  const hold = (what, key) => { if (!held.has(what)) { held.set(what, key); tell(); } };
  const release = (what) => { if (held.delete(what)) tell(); };
  const reset = () => { send("/reset", {}); onReset(); };
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (KEYS[event.code]) { hold(event.code, KEYS[event.code]); event.preventDefault(); }
    else if (event.code === "KeyR" && !event.repeat) reset();
    else if (event.code === "KeyC" && !event.repeat) onCamera();
  });
  addEventListener("keyup", (event) => release(event.code));
  addEventListener("blur", () => { if (held.size) { held.clear(); tell(); } });
  document.querySelectorAll("[data-key]").forEach((button) => {
    button.addEventListener("pointerdown", (event) => { button.setPointerCapture(event.pointerId); hold(button, button.dataset.key); });
    for (const end of ["pointerup", "pointercancel"]) button.addEventListener(end, () => release(button));
  });
  document.querySelectorAll("button").forEach((b) => b.addEventListener("click", () => b.blur()));
  byId("reset").addEventListener("click", reset);
  byId("camera").addEventListener("click", onCamera);
  setInterval(() => { if (held.size) tell(); }, 330);
}
