// Triangles of the shapes that a rover is made of, and of ground: places, normals, indices.

export function unpack(text, Kind) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  return new Kind(bytes.buffer);
}

export function box([a, b, c]) {
  const places = [], normals = [], index = [];
  for (let axis = 0; axis < 3; axis++)
    for (const sign of [-1, 1]) {
      const first = places.length / 3;
      for (const [u, v] of [[-1, -1], [1, -1], [1, 1], [-1, 1]]) {
        const corner = [0, 0, 0], normal = [0, 0, 0];
        corner[axis] = sign; corner[(axis + 1) % 3] = u * sign; corner[(axis + 2) % 3] = v;
        normal[axis] = sign;
        places.push(corner[0] * a, corner[1] * b, corner[2] * c);
        normals.push(...normal);
      }
      index.push(first, first + 1, first + 2, first, first + 2, first + 3);
    }
  return { places, normals, index };
}

// A surface of revolution about z: rows of [radius, z, normal outward, normal up].
function turned(rows, sides) {
  const places = [], normals = [], index = [];
  for (const [r, z, out, up] of rows)
    for (let i = 0; i <= sides; i++) {
      const a = 2 * Math.PI * i / sides, c = Math.cos(a), s = Math.sin(a);
      places.push(r * c, r * s, z);
      normals.push(out * c, out * s, up);
    }
  for (let k = 0; k + 1 < rows.length; k++)
    for (let i = 0; i < sides; i++) {
      const p = k * (sides + 1) + i, q = p + sides + 1;
      index.push(p, p + 1, q + 1, p, q + 1, q);
    }
  return { places, normals, index };
}

export const cylinder = ([r, h]) =>
  turned([[0, -h, 0, -1], [r, -h, 0, -1], [r, -h, 1, 0], [r, h, 1, 0], [r, h, 0, 1], [0, h, 0, 1]], 40);

export function sphere([a, b, c]) {
  const rows = [];
  for (let k = 0; k <= 16; k++) {
    const t = Math.PI * (k / 16 - 0.5);
    rows.push([Math.cos(t), Math.sin(t), Math.cos(t), Math.sin(t)]);
  }
  const made = turned(rows, 28);
  const length = [a, b, c];
  made.places = made.places.map((v, i) => v * length[i % 3]);
  made.normals = made.normals.map((v, i) => v / length[i % 3] * Math.min(a, b, c));
  return made;
}

// Rocks far away as one mesh, coarsely: [centre x, y, z, three semi-axes as vectors] each.
export function pebbles(rocks) {
  const ball = turned([0, 1, 2, 3, 4, 5, 6].map((k) => {
    const t = Math.PI * (k / 6 - 0.5);
    return [Math.cos(t), Math.sin(t), Math.cos(t), Math.sin(t)];
  }), 8);
  const places = [], normals = [], index = [];
  for (const [x, y, z, ...axes] of rocks) {
    const first = places.length / 3, long = [0, 3, 6].map((i) => Math.hypot(...axes.slice(i, i + 3)));
    for (let p = 0; p < ball.places.length; p += 3) {
      const place = [x, y, z], normal = [0, 0, 0];
      for (let i = 0; i < 3; i++)
        for (let k = 0; k < 3; k++) {
          place[k] += ball.places[p + i] * axes[3 * i + k];
          normal[k] += ball.places[p + i] * axes[3 * i + k] / long[i] ** 2;
        }
      const length = Math.hypot(...normal);
      places.push(...place);
      normals.push(...normal.map((v) => v / length));
    }
    for (const i of ball.index) index.push(first + i);
  }
  return { places, normals, index };
}

export function capsule([r, h]) {
  const rows = [];
  for (let k = 0; k <= 16; k++) {
    const t = Math.PI * (k / 16 - 0.5), up = Math.sin(t), out = Math.cos(t);
    rows.push([r * out, r * up + (k < 8 ? -h : h), out, up]);
    if (k === 8) rows.splice(-1, 0, [r, -h, 1, 0]);
  }
  return turned(rows, 28);
}

// Flat triangles: a mesh brings no normals.
export function mesh(shape) {
  const corners = unpack(shape.corners, Float32Array), faces = unpack(shape.faces, Uint32Array);
  const places = [], normals = [], index = [];
  for (let f = 0; f < faces.length; f += 3) {
    const [a, b, c] = [0, 1, 2].map((k) => Array.from(corners.subarray(3 * faces[f + k], 3 * faces[f + k] + 3)));
    const u = b.map((v, i) => v - a[i]), w = c.map((v, i) => v - a[i]);
    const n = [u[1] * w[2] - u[2] * w[1], u[2] * w[0] - u[0] * w[2], u[0] * w[1] - u[1] * w[0]];
    const length = Math.hypot(...n) || 1;
    index.push(places.length / 3, places.length / 3 + 1, places.length / 3 + 2);
    places.push(...a, ...b, ...c);
    for (let k = 0; k < 3; k++) normals.push(n[0] / length, n[1] / length, n[2] / length);
  }
  return { places, normals, index };
}

// A grid of heights, lowered by what `lower(x, y)` says.
export function ground(grid, lower = () => 0) {
  const z = unpack(grid.heights, Float32Array), { rows, cols } = grid;
  const places = new Float32Array(3 * rows * cols), normals = new Float32Array(3 * rows * cols);
  const dx = (grid.high[0] - grid.low[0]) / (cols - 1), dy = (grid.high[1] - grid.low[1]) / (rows - 1);
  const at = (j, i) => z[Math.min(Math.max(j, 0), rows - 1) * cols + Math.min(Math.max(i, 0), cols - 1)];
  for (let j = 0, k = 0; j < rows; j++)
    for (let i = 0; i < cols; i++, k += 3) {
      const x = grid.low[0] + i * dx, y = grid.low[1] + j * dy;
      places.set([x, y, at(j, i) - lower(x, y)], k);
      const east = (at(j, i + 1) - at(j, i - 1)) / (i > 0 && i < cols - 1 ? 2 * dx : dx);
      const north = (at(j + 1, i) - at(j - 1, i)) / (j > 0 && j < rows - 1 ? 2 * dy : dy);
      const length = Math.hypot(east, north, 1);
      normals.set([-east / length, -north / length, 1 / length], k);
    }
  const index = new Uint32Array(6 * (rows - 1) * (cols - 1));
  for (let j = 0, k = 0; j + 1 < rows; j++)
    for (let i = 0; i + 1 < cols; i++, k += 6) {
      const a = j * cols + i;
      index.set([a, a + 1, a + cols + 1, a, a + cols + 1, a + cols], k);
    }
  return { places, normals, index, height: (x, y) => at(Math.round((y - grid.low[1]) / dy), Math.round((x - grid.low[0]) / dx)) };
}

export function shapeOf(shape) {
  return { box: () => box(shape.size), cylinder: () => cylinder(shape.size), sphere: () => sphere(shape.size),
    capsule: () => capsule(shape.size), mesh: () => mesh(shape) }[shape.kind]();
}
