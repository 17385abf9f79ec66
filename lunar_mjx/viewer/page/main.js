// Fetches the scene, listens to the drive's pictures, and draws them.
import { add, clamp, lookAt, multiply, perspective, pose, scale } from "./maths.js";
import { Panel, listen } from "./panel.js";
import { Renderer } from "./render.js";
import { Replay } from "./replay.js";
import { cylinder, ground, pebbles, shapeOf, sphere } from "./shapes.js";

const STILL = pose([0, 0, 0], [1, 0, 0, 0]);
const GHOST = [0.34, 0.71, 0.91], GHOSTLY = 0.55, POST = [0.03, 0.7], FLAG = [0.9, 0.62, 0.0];
const ANGLE = 0.75, FETCH_AGAIN = 7, MOST_BARS = 80000, VIEWS = ["follow", "fixed", "from above"];

async function json(path) {
  const answer = await fetch(path);
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
}

class View {
  constructor(scene, canvas) {
    this.scene = scene;
    this.renderer = new Renderer(canvas, scene.sun, scene.light, scene.cloud);
    this.rover = scene.shapes.filter((s) => s.colour[3] > 0).map((shape) => ({ mesh: this.renderer.upload(shapeOf(shape)),
      body: shape.body, local: pose(shape.place, shape.turn), colour: shape.colour.slice(0, 3),
      kind: shape.kind === "cylinder" && scene.wheels.some((w) => w.body === shape.body) ? 4 : 0 }));
    this.post = this.renderer.upload(cylinder(POST));
    this.ball = this.renderer.upload(sphere([1, 1, 1]));
    this.soil = [];
    this.camera = { around: 0, above: 0.36, away: 2.1 * scene.size + 1.2, mode: 0, yaw: null, target: null };
    this.drag(canvas);
    this.restart();
  }

  restart() {
    this.last = null;
    this.run = this.scene.wheels.map(() => 0);
    this.prints = [];
    this.renderer.clearTracks(this.middle ?? [0, 0]);
  }

  async surround(x, y) {
    if (this.fetching || (this.middle && Math.hypot(x - this.middle[0], y - this.middle[1]) < FETCH_AGAIN)) return;
    this.fetching = true;
    try {
      const seen = await json(`/ground?x=${x.toFixed(3)}&y=${y.toFixed(3)}`);
      const { near, far } = seen, fine = ground(near);
      // the coarse ground lies under the fine one, and never cuts through it
      const step = Math.max((far.high[0] - far.low[0]) / (far.cols - 1), (far.high[1] - far.low[1]) / (far.rows - 1));
      const under = (px, py) => (px > near.low[0] + step && px < near.high[0] - step &&
        py > near.low[1] + step && py < near.high[1] - step ? 3 : 0.05);
      this.soil.forEach((part) => part.mesh !== this.ball && this.renderer.free(part.mesh));
      this.soil = [{ mesh: this.renderer.upload(fine), model: STILL, colour: this.scene.soil, kind: 1 },
        { mesh: this.renderer.upload(ground(far, under)), model: STILL, colour: this.scene.soil, kind: 2 }];
      const inside = ([cx, cy]) => cx > near.low[0] && cx < near.high[0] && cy > near.low[1] && cy < near.high[1];
      const away = seen.rocks.filter((rock) => !inside(rock));
      // one mesh, or a field of a thousand boulders would take as many calls a picture
      if (away.length) this.soil.push({ mesh: this.renderer.upload(pebbles(away)), model: STILL, colour: this.scene.rock, kind: 3, far: true });
      for (const [cx, cy, cz, ...axes] of seen.rocks.filter(inside)) {
        const columns = [0, 3, 6].flatMap((i) => [...axes.slice(i, i + 3), 0]);
        const model = new Float32Array([...columns, cx, cy, cz, 1]);
        this.soil.push({ mesh: this.ball, model, colour: this.scene.rock, kind: 3 });
      }
      this.middle = [x, y];
      this.renderer.clearTracks(this.middle);
      this.prints.forEach((bar) => this.renderer.print(bar));
      this.height = fine.height;
      document.body.dataset.ground = this.middle.join(" ");
    } finally {
      this.fetching = false;
    }
  }

  // The wheels' tracks between two pictures, bar by bar.
  tread(bodies) {
    this.scene.wheels.forEach((wheel, k) => {
      const here = bodies[wheel.body], before = this.last?.[wheel.body];
      if (!before) return;
      const way = [here[0] - before[0], here[1] - before[1]], length = Math.hypot(...way);
      if (length < 1e-5 || length > 1) return;
      const unit = [way[0] / length, way[1] / length];
      const long = wheel.pitch / 3, { rut, print } = this.scene.tracks;   // the texture has no room for finer prints
      for (let bar = Math.ceil(this.run[k] / long); bar * long < this.run[k] + length; bar++) {
        const s = bar * long - this.run[k], shade = 255 * (1 - (bar % 3 ? rut : print));
        this.prints.push([before[0] + s * unit[0], before[1] + s * unit[1], ...unit, wheel.width, long, shade]);
        this.renderer.print(this.prints.at(-1));
      }
      this.run[k] += length;
    });
    if (this.prints.length > MOST_BARS) this.prints.splice(0, MOST_BARS / 4);
    this.last = bodies;
  }

  show(bodies, { ghost = null, goal = null, dust = [] } = {}) {
    Object.assign(this, { ghost, goal, dust });
    const chassis = bodies[this.scene.chassis], jumped = this.last &&
      Math.hypot(chassis[0] - this.last[this.scene.chassis][0], chassis[1] - this.last[this.scene.chassis][1]) > 0.5;
    if (jumped) {
      this.restart();
      Object.assign(this.camera, { target: null });
    }
    this.tread(bodies);
    this.bodies = bodies;
    this.surround(chassis[0], chassis[1]);
  }

  draw(seconds) {
    if (!this.bodies) return;
    const { camera, scene } = this, at = this.bodies[scene.chassis];
    const [w, x, y, z] = at.slice(3), yaw = Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z));
    if (camera.yaw === null) {   // behind the rover, on the side that the Sun lights
      const side = Math.sin(Math.atan2(scene.sun[1], scene.sun[0]) - yaw);
      Object.assign(camera, { yaw, around: side > 0 ? 2.45 : -2.45 });
    }
    const ease = 1 - Math.exp(-seconds / 0.35);
    camera.yaw += ease * Math.atan2(Math.sin(yaw - camera.yaw), Math.cos(yaw - camera.yaw));
    const wanted = [at[0], at[1], at[2] + 0.12 * scene.size];
    camera.target = camera.target ? camera.target.map((v, i) => v + (1 - Math.exp(-seconds / 0.12)) * (wanted[i] - v)) : wanted;
    const around = camera.around + (camera.mode === 0 ? camera.yaw : 0);
    const above = camera.mode === 2 ? 1.45 : camera.above;
    const from = [Math.cos(above) * Math.cos(around), Math.cos(above) * Math.sin(around), Math.sin(above)];
    const eye = add(camera.target, scale(from, camera.away));
    eye[2] = Math.max(eye[2], (this.height?.(eye[0], eye[1]) ?? -Infinity) + 0.25);
    const { clientWidth: width, clientHeight: height } = this.renderer.canvas;
    const clip = multiply(perspective(ANGLE, width / Math.max(height, 1), 0.05, 600), lookAt(eye, camera.target, [0, 0, 1]));
    const standing = (bodies, more) => this.rover.map((part) => {
      const body = bodies[part.body];
      return { ...part, ...more, model: multiply(pose(body.slice(0, 3), body.slice(3)), part.local) };
    });
    const ghost = this.ghost ? standing(this.ghost, { colour: GHOST, kind: 0, alpha: GHOSTLY }) : [];
    this.renderer.draw([...standing(this.bodies), ...this.marks(), ...this.soil], ghost, at.slice(0, 3), eye, clip,
      { grains: this.dust, colour: this.scene.soil, angle: ANGLE });
  }

  // Where the rover wants to go: a post with a ball on it.
  marks() {
    if (!this.goal) return [];
    const [x, y, z] = this.goal, top = new Float32Array([0.12, 0, 0, 0, 0, 0.12, 0, 0, 0, 0, 0.12, 0, x, y, z + 2 * POST[1], 1]);
    return [{ mesh: this.post, model: pose([x, y, z + POST[1]], [1, 0, 0, 0]), colour: FLAG, kind: 0 },
      { mesh: this.ball, model: top, colour: FLAG, kind: 0 }];
  }

  drag(canvas) {
    const { camera } = this;
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      if (!event.buttons) return;
      camera.around -= 0.006 * event.movementX;
      camera.above = clamp(camera.above + 0.006 * event.movementY, 0.06, 1.5);
    });
    canvas.addEventListener("wheel", (event) => {
      camera.away = clamp(camera.away * Math.exp(0.0012 * event.deltaY), 0.8, 60);
      event.preventDefault();
    }, { passive: false });
  }
}

async function start() {
  const scene = await json("/scene"), panel = new Panel(scene);
  let view = null, trouble = "";
  try {
    view = new View(scene, document.getElementById("view"));
  } catch (error) {
    trouble = error.message;   // the readings and the keys still work
  }
  let last = performance.now(), replay = null;
  const frame = (now) => {
    const seconds = Math.min((now - last) / 1000, 0.2);
    replay?.tick(seconds);
    view?.draw(seconds);
    last = now;
    requestAnimationFrame(frame);
  };
  requestAnimationFrame(frame);
  const button = document.getElementById("camera");
  const name = () => { button.textContent = `camera: ${VIEWS[view?.camera.mode ?? 0]}`; };
  name();
  const turn = () => {
    if (!view) return;
    view.camera.around += view.camera.mode === 0 ? view.camera.yaw : 0;
    view.camera.mode = (view.camera.mode + 1) % VIEWS.length;
    if (view.camera.mode === 0) view.camera.around -= view.camera.yaw;
    name();
  };
  if (scene.replay) {
    replay = new Replay(scene, view, turn);
    panel.note(trouble);
    return;
  }
  listen(() => view?.restart(), turn);
  const pictures = new EventSource("/pictures");
  pictures.onmessage = (event) => {
    const now = JSON.parse(event.data);
    now.note ||= trouble;
    panel.show(now);
    view?.show(now.bodies, now);
    document.body.dataset.grains = now.dust.length / 5;
    document.body.dataset.pictures = 1 + Number(document.body.dataset.pictures ?? 0);
  };
  pictures.onerror = () => panel.note("The drive has ended, or its connection is lost.");
}

start().catch((error) => {
  const note = document.getElementById("note");
  note.hidden = false;
  note.textContent = error.message;
});
