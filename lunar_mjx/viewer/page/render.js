// Draws with WebGL 2: one hard Sun with a shadow map, regolith made in the shader, wheel tracks in a texture that
// repeats over the ground.
import { multiply, orthographic, lookAt, add, scale } from "./maths.js";

const SHADOW = 2048, REACH = 11, TRACK = 2048;
const TRACK_SPAN = 36;

const DEPTH_VERTEX = `#version 300 es
layout(location = 0) in vec3 place;
uniform mat4 light, model;
void main() { gl_Position = light * model * vec4(place, 1.0); }`;
const DEPTH_FRAGMENT = `#version 300 es
precision highp float;
void main() {}`;

// From light to the screen as the other cameras' film has it, up to where it would saturate: a shoulder in place of a
// clip, so that the brightest parts of the rover keep their shading.
const SHOWN = `
uniform float gamma;
vec3 shown(vec3 sum) {
  const float knee = 0.5;
  vec3 film = min(sum, knee) + (1.0 - knee) * (1.0 - exp(-max(sum - knee, 0.0) / (1.0 - knee)));
  return pow(max(film, 0.0), vec3(1.0 / gamma));
}`;

const VERTEX = `#version 300 es
layout(location = 0) in vec3 place;
layout(location = 1) in vec3 normal;
uniform mat4 camera, model, light;
uniform vec3 sun;
uniform float offset;
out vec3 at, facing, own;
out vec4 shade;
out float edgewise;
void main() {
  edgewise = abs(normal.z);
  vec4 world = model * vec4(place, 1.0);
  at = world.xyz;
  own = place;
  facing = transpose(inverse(mat3(model))) * normal;  // a stretched ball's normals lean the other way
  float slant = 1.0 - max(dot(normalize(facing), sun), 0.0);
  shade = light * vec4(world.xyz + normalize(facing) * offset * (0.4 + slant), 1.0);
  gl_Position = camera * world;
}`;

const FRAGMENT = `#version 300 es
precision highp float;
precision highp sampler2DShadow;
in vec3 at, facing, own;
in vec4 shade;
in float edgewise;   // 1 on a wheel's flanks, 0 on its rim
uniform vec3 eye, sun, colour;
uniform float exposure, fill, span, alpha;   // of the Sun's light and of what the ground throws back
uniform vec2 middle;         // of the ground on which tracks are drawn
uniform int kind;            // 0 rover, 1 near ground, 2 far ground, 3 rock, 4 wheel
uniform sampler2DShadow shadows;
uniform sampler2D tracks;
out vec4 pixel;
${SHOWN}
float random(ivec2 p) {
  uint n = uint(p.x) * 1664525u + uint(p.y) * 22695477u + 1013904223u;
  n ^= n >> 15; n *= 2246822519u; n ^= n >> 13; n *= 3266489917u; n ^= n >> 16;
  return float(n >> 8) / 16777216.0;
}
// Value and gradient.
vec3 noise(vec2 p) {
  ivec2 i = ivec2(floor(p));
  vec2 f = fract(p), s = f * f * (3.0 - 2.0 * f);
  float a = random(i), b = random(i + ivec2(1, 0)), c = random(i + ivec2(0, 1)), d = random(i + ivec2(1, 1));
  vec2 slope = 6.0 * f * (1.0 - f) * (vec2(b - a, c - a) + (a - b - c + d) * s.yx);
  return vec3(mix(mix(a, b, s.x), mix(c, d, s.x), s.y), slope);
}
// Mottling down to what a pixel still resolves, with its gradient.
vec3 regolith(vec2 p, float footprint) {
  vec3 sum = vec3(0.0);
  float size = 1.9;
  for (int k = 0; k < 6; k++) {
    float seen = clamp(size / (2.5 * footprint) - 0.6, 0.0, 1.0) * (k < 2 ? 0.55 : 1.0);
    if (seen <= 0.0) break;
    vec3 one = noise(p / size + float(17 * k));
    sum += seen * vec3(one.x - 0.5, one.yz / size);
    size *= 0.43;
  }
  return sum;
}
float lit() {
  vec3 p = shade.xyz * 0.5 + 0.5;
  vec2 edge = abs(shade.xy);
  float out_of_map = smoothstep(0.92, 0.99, max(edge.x, edge.y));
  if (out_of_map >= 1.0 || p.z > 1.0) return 1.0;
  float sum = 0.0, texel = 1.0 / float(textureSize(shadows, 0).x);
  for (int i = -1; i <= 1; i++)
    for (int j = -1; j <= 1; j++) sum += texture(shadows, vec3(p.xy + texel * vec2(i, j), p.z));
  return mix(sum / 9.0, 1.0, out_of_map);
}
void main() {
  vec3 n = normalize(facing), base = colour, toEye = normalize(eye - at);
  float footprint = max(length(dFdx(at)), length(dFdy(at))), gloss = 0.12, trodden = 1.0;
  if (kind == 1 || kind == 2) {
    gloss = 0.0;
    vec3 grain = regolith(at.xy, footprint);
    n = normalize(n - vec3(0.0048 * grain.yz, 0.0));
    base *= 1.0 + 0.13 * grain.x;
    vec2 from = abs(at.xy - middle);
    if (kind == 1 && max(from.x, from.y) < 0.5 * span) {
      vec2 uv = at.xy / span;
      float e = 1.0 / float(textureSize(tracks, 0).x);
      float rut = texture(tracks, uv).r;
      vec2 across = vec2(texture(tracks, uv + vec2(e, 0.0)).r - texture(tracks, uv - vec2(e, 0.0)).r,
                         texture(tracks, uv + vec2(0.0, e)).r - texture(tracks, uv - vec2(0.0, e)).r);
      n = normalize(n + 0.80 * vec3(across, 0.0));
      trodden = 1.0 - rut;
    }
  } else if (kind == 3) {
    gloss = 0.0;
    float grain = noise(at.xy * 9.0 + at.z * 7.0).x + 0.6 * noise(at.yz * 31.0 + at.x * 5.0).x;
    base *= 0.72 + 0.34 * grain;
  } else if (kind == 4) {
    // grousers and spokes, so that the eye sees it roll
    float turn = atan(own.y, own.x) / 6.2831853;
    float rim = step(abs(fract(24.0 * turn) - 0.5), 0.16), spoke = step(abs(fract(6.0 * turn) - 0.5), 0.10);
    // bright metal is drawn no brighter than sunlit soil, which the picture is exposed for
    base = min(base, vec3(0.34)) * (0.75 + 0.75 * (edgewise > 0.5 ? spoke : rim));
  }
  float facingSun = max(dot(n, sun), 0.0), light = facingSun > 0.0 ? (kind == 2 ? 1.0 : lit()) : 0.0;  // else the seam would cast one
  float shine = gloss * pow(max(dot(n, normalize(sun + toEye)), 0.0), 40.0);
  // light thrown back by the ground, so that shadows are dark but not holes
  float thrown = fill * (1.0 + 0.8 * (1.0 - n.z));
  vec3 sum = base * (exposure * facingSun * light + thrown) + vec3(0.75 * shine * light * exposure);
  // what is on the screen is darkened, as the other cameras' tracks are
  pixel = vec4(shown(sum) * trodden, alpha);
}`;

// Grains of dust as soft points. Light is scattered once: exp(-t) of what is behind comes through.
const DUST_VERTEX = `#version 300 es
precision highp sampler2DShadow;
layout(location = 0) in vec4 grain;   // place and spread, m
layout(location = 1) in float area;   // cross-section, cm2
uniform mat4 camera, light;
uniform vec3 eye, sun;
uniform vec4 cloud;                   // I/F of 1 over that of level soil; albedo, lobe and share thrown back (Regolith.cloud)
uniform float focal;                  // pixels
uniform sampler2DShadow shadows;
out float thick, glow;
float lobe(float towards) { return (1.0 - cloud.z * cloud.z) / pow(1.0 + cloud.z * cloud.z - 2.0 * cloud.z * towards, 1.5); }
void main() {
  gl_Position = camera * vec4(grain.xyz, 1.0);
  float scale = focal / max(gl_Position.w, 0.01), sigma = clamp(grain.w * scale, 0.6, 20.0);
  gl_PointSize = 6.0 * sigma;
  thick = 1e-4 * area * scale * scale / (6.2831853 * sigma * sigma);
  vec3 p = (light * vec4(grain.xyz, 1.0)).xyz;
  float seen = max(abs(p.x), abs(p.y)) < 0.99 && p.z < 1.0 ? texture(shadows, p * 0.5 + 0.5) : 1.0;
  float phase = dot(normalize(eye - grain.xyz), sun);
  glow = seen * cloud.x * 0.125 * cloud.y * ((1.0 + cloud.w) * lobe(phase) + (1.0 - cloud.w) * lobe(-phase));
}`;
const DUST_FRAGMENT = `#version 300 es
precision highp float;
in float thick, glow;
uniform vec3 colour, sun;
uniform float exposure, fill;
out vec4 pixel;
${SHOWN}
void main() {
  vec2 at = 6.0 * (gl_PointCoord - 0.5);
  float t = thick * exp(-0.5 * dot(at, at));
  pixel = vec4(shown(colour * (exposure * sun.z * glow + fill)), 1.0 - exp(-t));
}`;

export class Renderer {
  // light: {exposure, fill, gamma}, see `viewer/scene.py`.
  constructor(canvas, sun, light, cloud) {
    const gl = canvas.getContext("webgl2", { antialias: true, powerPreference: "high-performance", preserveDrawingBuffer: true });
    if (!gl) throw new Error("This browser has no WebGL 2: use a recent Firefox, Chrome, Edge or Safari with graphics acceleration.");
    Object.assign(this, { gl, canvas, sun, light, cloud });
    this.depth = this.program(DEPTH_VERTEX, DEPTH_FRAGMENT);
    this.surface = this.program(VERTEX, FRAGMENT);
    this.dust = this.program(DUST_VERTEX, DUST_FRAGMENT);
    this.grains = this.grainField();
    this.shadowMap();
    this.trackMap();
    gl.enable(gl.DEPTH_TEST);
  }

  program(vertex, fragment) {
    const { gl } = this, made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
    const at = {};
    for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); i++) {
      const { name } = gl.getActiveUniform(made, i);
      at[name] = gl.getUniformLocation(made, name);
    }
    return { made, at };
  }

  upload({ places, normals, index }) {
    const { gl } = this, array = gl.createVertexArray(), buffers = [];
    gl.bindVertexArray(array);
    [places, normals].forEach((values, slot) => {
      const buffer = gl.createBuffer();
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(values), gl.STATIC_DRAW);
      gl.enableVertexAttribArray(slot);
      gl.vertexAttribPointer(slot, 3, gl.FLOAT, false, 0, 0);
      buffers.push(buffer);
    });
    const order = gl.createBuffer();
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, order);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint32Array(index), gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    return { array, count: index.length, buffers: [...buffers, order] };
  }

  free(mesh) {
    mesh.buffers.forEach((b) => this.gl.deleteBuffer(b));
    this.gl.deleteVertexArray(mesh.array);
  }

  grainField() {
    const { gl } = this, array = gl.createVertexArray(), buffer = gl.createBuffer();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    [[4, 0], [1, 16]].forEach(([size, start], slot) => {
      gl.enableVertexAttribArray(slot);
      gl.vertexAttribPointer(slot, size, gl.FLOAT, false, 20, start);
    });
    gl.bindVertexArray(null);
    return { array, buffer };
  }

  // grains: five numbers each; colour: of level ground; focal: pixels. The shadow map is bound already.
  drawDust(grains, colour, focal, eye, camera, light) {
    const { gl } = this, { at } = this.dust;
    gl.useProgram(this.dust.made);
    gl.uniformMatrix4fv(at.camera, false, camera);
    gl.uniformMatrix4fv(at.light, false, light);
    gl.uniform3fv(at.eye, eye);
    gl.uniform3fv(at.sun, this.sun);
    gl.uniform4fv(at.cloud, this.cloud);
    this.exposeBy(at);
    gl.uniform3fv(at.colour, colour);
    gl.uniform1f(at.focal, focal);
    gl.uniform1i(at.shadows, 0);
    gl.bindVertexArray(this.grains.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.grains.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(grains), gl.DYNAMIC_DRAW);
    gl.depthMask(false);   // grains hide no grains
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArrays(gl.POINTS, 0, grains.length / 5);
    gl.disable(gl.BLEND);
    gl.depthMask(true);
  }

  shadowMap() {
    const { gl } = this;
    this.shadows = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.shadows);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.DEPTH_COMPONENT24, SHADOW, SHADOW);
    for (const [name, value] of [[gl.TEXTURE_MIN_FILTER, gl.LINEAR], [gl.TEXTURE_MAG_FILTER, gl.LINEAR],
      [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE],
      [gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE], [gl.TEXTURE_COMPARE_FUNC, gl.LEQUAL]])
      gl.texParameteri(gl.TEXTURE_2D, name, value);
    this.target = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, this.shadows, 0);
    gl.drawBuffers([gl.NONE]);
    gl.readBuffer(gl.NONE);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  trackMap() {
    const { gl } = this;
    this.ruts = new Uint8Array(TRACK * TRACK);
    this.tracks = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.tracks);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.R8, TRACK, TRACK);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  }

  // Begins with untrodden ground around a place; tracks farther away than half a span would repeat on it.
  clearTracks(middle) {
    this.middle = middle;
    this.ruts.fill(0);
    this.uploadRows(0, TRACK);
  }

  uploadRows(first, count) {
    const { gl } = this;
    gl.bindTexture(gl.TEXTURE_2D, this.tracks);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, first, TRACK, count, gl.RED, gl.UNSIGNED_BYTE,
      this.ruts.subarray(first * TRACK, (first + count) * TRACK));
  }

  // One bar of a track at x, y across the way dx, dy (a unit vector).
  print([x, y, dx, dy, width, length, depth]) {
    if (Math.max(Math.abs(x - this.middle[0]), Math.abs(y - this.middle[1])) > TRACK_SPAN / 2) return;
    const cell = TRACK_SPAN / TRACK, wrap = (i) => ((i % TRACK) + TRACK) % TRACK;
    const reach = Math.hypot(width, length) / 2 + cell;
    const rows = [Math.floor((y - reach) / cell), Math.ceil((y + reach) / cell)];
    for (let j = rows[0]; j <= rows[1]; j++)
      for (let i = Math.floor((x - reach) / cell); i <= Math.ceil((x + reach) / cell); i++) {
        const u = (i + 0.5) * cell - x, v = (j + 0.5) * cell - y;
        if (Math.abs(u * dx + v * dy) <= length / 2 + 0.3 * cell && Math.abs(v * dx - u * dy) <= width / 2) {
          const k = wrap(j) * TRACK + wrap(i);
          this.ruts[k] = depth;
        }
      }
    for (let j = rows[0]; j <= rows[1]; j++) (this.dirty ??= new Set()).add(wrap(j));
  }

  flushTracks() {
    if (!this.dirty?.size) return;
    const rows = [...this.dirty].sort((a, b) => a - b);
    for (let i = 0; i < rows.length;) {
      let j = i;
      while (j + 1 < rows.length && rows[j + 1] === rows[j] + 1) j++;
      this.uploadRows(rows[i], j - i + 1);
      i = j + 1;
    }
    this.dirty.clear();
  }

  // parts, ghosts: [{mesh, model, colour, kind}]; ghosts have an alpha too, and cast no shadow; centre: of what casts shadows; eye and camera: world to clip;
  // dust: {grains, colour, angle}, where angle is the height of the picture, rad.
  draw(parts, ghosts, centre, eye, camera, dust) {
    const { gl, canvas } = this;
    this.flushTracks();
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [w, h] = [canvas.clientWidth * ratio | 0, canvas.clientHeight * ratio | 0];
    if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
    const up = Math.abs(this.sun[2]) > 0.95 ? [1, 0, 0] : [0, 0, 1];
    const light = multiply(orthographic(REACH, 1, 120), lookAt(add(centre, scale(this.sun, 60)), centre, up));

    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.viewport(0, 0, SHADOW, SHADOW);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.useProgram(this.depth.made);
    gl.enable(gl.POLYGON_OFFSET_FILL);
    gl.polygonOffset(2.0, 4.0);
    gl.uniformMatrix4fv(this.depth.at.light, false, light);
    for (const part of parts)
      if (part.kind !== 2 && !part.far) {
        gl.uniformMatrix4fv(this.depth.at.model, false, part.model);
        this.triangles(part.mesh);
      }
    gl.disable(gl.POLYGON_OFFSET_FILL);

    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, w, h);
    gl.clearColor(0, 0, 0, 1);   // the sky: a camera that exposes for sunlit soil sees nothing in it
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.depthFunc(gl.LEQUAL);

    const { at } = this.surface;
    gl.useProgram(this.surface.made);
    gl.uniformMatrix4fv(at.camera, false, camera);
    gl.uniformMatrix4fv(at.light, false, light);
    gl.uniform3fv(at.eye, eye);
    gl.uniform3fv(at.sun, this.sun);
    this.exposeBy(at);
    gl.uniform1f(at.span, TRACK_SPAN);
    gl.uniform2fv(at.middle, this.middle);
    gl.uniform1f(at.offset, 1.6 * 2 * REACH / SHADOW);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.tracks);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.shadows);
    gl.uniform1i(at.shadows, 0);
    gl.uniform1i(at.tracks, 1);
    const each = (list) => {
      for (const part of list) {
        gl.uniformMatrix4fv(at.model, false, part.model);
        gl.uniform3fv(at.colour, part.colour);
        gl.uniform1i(at.kind, part.kind);
        gl.uniform1f(at.alpha, part.alpha ?? 1);
        this.triangles(part.mesh);
      }
    };
    each(parts);
    if (dust.grains.length)
      this.drawDust(dust.grains, dust.colour, 0.5 * h / Math.tan(0.5 * dust.angle), eye, camera, light);
    if (!ghosts.length) return;
    gl.useProgram(this.surface.made);
    gl.colorMask(false, false, false, false);   // first how deep it is, so that only its nearest faces are blended
    each(ghosts);
    gl.colorMask(true, true, true, true);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    each(ghosts);
    gl.disable(gl.BLEND);
  }

  exposeBy(at) {
    for (const name of ["exposure", "fill", "gamma"]) this.gl.uniform1f(at[name], this.light[name]);
  }

  triangles(mesh) {
    this.gl.bindVertexArray(mesh.array);
    this.gl.drawElements(this.gl.TRIANGLES, mesh.count, this.gl.UNSIGNED_INT, 0);
  }
}
