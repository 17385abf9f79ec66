"""A rover on its terrain as MuJoCo draws it: ground near and far, boulders, regolith, black sky, one hard Sun."""

from __future__ import annotations

import dataclasses
import io
import math
from collections.abc import Sequence
from typing import Any

import jax
import mujoco
import numpy as np
from PIL import Image

from lunar_mjx.cameras.mount import front_mount
from lunar_mjx.cameras.photometry import LOWEST_SUN, METERED, ROCK_BRIGHTNESS, Film, Regolith
from lunar_mjx.cameras.pinhole import Pose
from lunar_mjx.cameras.texture import ALBEDO, Track, TrackPainter, regolith
from lunar_mjx.errors import bad_input
from lunar_mjx.rover import Rover
from lunar_mjx.rover.look import seen_spec
from lunar_mjx.rover.mjcf import quaternion
from lunar_mjx.terrain import Terrain
from lunar_mjx.terrain.rocks import semi_axes

GROUND, FAR_GROUND, ROCK, FRONT = "ground", "far_ground", "rock", "front"
LEVEL_LIGHT = 0.55
"""Brightness of the Sun's light on level ground, to which `texture.ALBEDO` is fitted."""

AMBIENT, HEADLIGHT = 0.04, 0.05
"""Brightness of light from everywhere, and from the camera, in which shadows are no holes: choices."""
BALL = 2.0 / 3.0
"""Mean cosine between viewer and what is seen of a ball."""
FILL = AMBIENT + HEADLIGHT * METERED
"""Of both, on level ground as `Film` meters it."""


@dataclasses.dataclass(frozen=True)
class SceneDetail:
    """How finely a scene is drawn."""

    # Most nodes per side of the near and the far height field, and pixels of the pictures of their ground.
    nodes: int = 420
    far_nodes: int = 160
    texels: int = 2048
    far_texels: int = 1024
    far_rocks: float = 60.0
    """How far beyond the near ground rocks are drawn, m: as far as the cameras in JAX look."""
    drop: float = 3.0
    """How far the far ground is lowered under the near one, m."""
    rock_slices: tuple[int, int] = (28, 16)
    """Faces of a rock around it and from its foot to its top."""
    shadow_reach: float = 40.0
    """How far around the rover things throw shadows, m. MuJoCo has one shadow map: one of 60 m draws stripes on slopes
    that the Sun grazes."""
    shadow_texels: int = 8192
    """Of a side of the shadow map: a centimetre each."""


SCENE_DETAIL = SceneDetail()


@dataclasses.dataclass(frozen=True)
class Sun:
    """Where the Sun stands: azimuth clockwise from north (y), elevation above the horizon, deg."""

    azimuth_deg: float = 135.0
    elevation_deg: float = 15.0

    def __post_init__(self) -> None:
        if not 0.0 < self.elevation_deg <= 90.0:
            raise bad_input("sun", "elevation_deg", self.elevation_deg, "is outside (0, 90]", "give about 15")
        if not math.isfinite(self.azimuth_deg):
            raise bad_input("sun", "azimuth_deg", self.azimuth_deg, "is not finite", "give a compass direction in deg")

    @property
    def direction(self) -> np.ndarray:
        """Unit vector towards the Sun."""
        a, e = math.radians(self.azimuth_deg), math.radians(self.elevation_deg)
        return np.array([math.sin(a) * math.cos(e), math.cos(a) * math.cos(e), math.sin(e)])

    @property
    def exposure(self) -> float:
        """Brightness of the light, by which level ground looks alike down to the lowest Sun that `Film` exposes for."""
        return LEVEL_LIGHT / max(math.sin(math.radians(self.elevation_deg)), LOWEST_SUN)


@dataclasses.dataclass(frozen=True)
class Patch:
    """A part of a terrain's grid: heights (rows, cols) m, and the places of its first and last node, m."""

    heights: np.ndarray
    low: tuple[float, float]
    high: tuple[float, float]


def shadow_light(at: np.ndarray, sun: Sun) -> np.ndarray:
    """Where the light of the shadow map stands, (3,) m, so that shadows are drawn around a place (3,) m."""
    return at + SCENE_DETAIL.shadow_reach * sun.direction


def cut(terrain: Terrain, low: np.ndarray, high: np.ndarray, most: int) -> Patch:
    """The grid between two corners, thinned to at most `most` nodes per side."""
    spans = _spans(terrain, low, high)
    # Every so many nodes and no means: nodes that are drawn lie on the ground that the wheels touch.
    return _patch(terrain, *(np.arange(first, end + 1, _thinning(end - first, most)) for first, end, _ in spans))


def _spans(terrain: Terrain, low: np.ndarray, high: np.ndarray) -> list[tuple[int, int, int]]:
    """Along x and along y: the first and the last node between two corners, and the last one of the grid."""
    field, found = terrain.field, []
    for axis, origin in ((1, float(field.x0)), (0, float(field.y0))):
        last, cell = field.heights.shape[axis] - 1, float(field.cell)
        first = int(np.clip(math.floor((low[1 - axis] - origin) / cell), 0, last - 1))
        found.append((first, int(np.clip(math.ceil((high[1 - axis] - origin) / cell), first + 1, last)), last))
    return found


def _thinning(cells: int, most: int) -> int:
    """Of how many nodes one is drawn, so that at most `most` are."""
    return max(1, math.ceil(cells / (most - 1)))


def _patch(terrain: Terrain, columns: np.ndarray, rows: np.ndarray) -> Patch:
    """The nodes of some columns and rows, evenly spaced."""
    field = terrain.field
    x, y = (
        float(origin) + nodes[[0, -1]] * float(field.cell) for origin, nodes in ((field.x0, columns), (field.y0, rows))
    )
    heights = np.asarray(field.heights, float)[np.ix_(rows, columns)]
    return Patch(heights, (float(x[0]), float(y[0])), (float(x[1]), float(y[1])))


def near_and_far(terrain: Terrain, low: np.ndarray, high: np.ndarray) -> tuple[Patch, Patch | None]:
    """The ground between two corners, drawn finely, and all of it coarsely, joined without a step.

    The fine ground ends at nodes of the coarse one, and there lies on its edges: in a low Sun a step of centimetres
    would draw a line of shadow. Where the coarse ground ends, the fine one may reach a little further.

    Returns:
      The near patch, and the far one; None where the near one is all that there is.
    """
    near, far = [], []
    for first, end, last in _spans(terrain, low, high):
        fine = _thinning(end - first, SCENE_DETAIL.nodes)
        coarse = fine * math.ceil(_thinning(last, SCENE_DETAIL.far_nodes) / fine)
        nodes = np.arange(0, last + 1, coarse)
        stop = -(-end // coarse) * coarse
        near.append(np.arange(first // coarse * coarse, (stop if stop <= nodes[-1] else end) + 1, fine))
        far.append(nodes)
    patch = _patch(terrain, *near)
    if all(n[0] == 0 and n[-1] >= f[-1] for n, f in zip(near, far, strict=True)):
        return patch, None
    whole = _patch(terrain, *far)
    # Views, so that columns and rows are one case: an edge of the first and the last node along each axis.
    for axis, heights, coarse_heights in ((0, patch.heights.T, whole.heights.T), (1, patch.heights, whole.heights)):
        along, far_along = near[1 - axis], far[1 - axis]
        covered = along <= far_along[-1]
        for edge in (0, -1):
            node = near[axis][edge]
            if 0 < node < far[axis][-1]:
                level = coarse_heights[np.searchsorted(far[axis], node)]
                heights[edge, covered] = np.interp(along[covered], far_along, level)
    return patch, whole


def build_scene(
    rover: Rover,
    terrain: Terrain,
    places: np.ndarray,
    sun: Sun,
    tracks: Sequence[Track] = (),
    margin: float = 15.0,
    mount: Pose | None = None,
    fovy_deg: float = 60.0,
) -> tuple[Any, TrackPainter]:
    """The compiled scene of rover and ground, and the painter of its ground.

    Args:
      rover, terrain: what stands where.
      places: (n, 2) m that the near ground covers with `margin` m around.
      sun: the light. tracks: wheel tracks on the near ground.
      mount: of the camera "front" in the chassis frame; `front_mount` if None. fovy_deg: its angle of view.

    Returns:
      The compiled `MjModel`, with untrodden ground, and what paints the tracks into its texture.
    """
    # MuJoCo reads arrays of the host; a terrain of a batch lies on the device.
    terrain = jax.device_get(terrain)
    spec = seen_spec(rover)
    spec.stat.extent = 1.0
    spec.stat.center = [0.0, 0.0, 0.0]
    visual = spec.visual
    visual.map.znear, visual.map.zfar = 0.02, 400.0
    visual.map.shadowclip, visual.map.shadowscale = SCENE_DETAIL.shadow_reach, 0.9
    visual.quality.shadowsize, visual.quality.offsamples = SCENE_DETAIL.shadow_texels, 4
    visual.headlight.ambient, visual.headlight.diffuse = [AMBIENT] * 3, [HEADLIGHT] * 3
    visual.headlight.specular = [0.0] * 3
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=[0, 0, 0],
        rgb2=[0, 0, 0],
        width=32,
        height=192,
    )
    spec.worldbody.add_light(
        name="sun",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=[0, 0, 20],
        dir=(-sun.direction).tolist(),
        castshadow=True,
        diffuse=[sun.exposure] * 3,
        ambient=[0.0] * 3,
        specular=[0.15] * 3,
    )
    low, high = places.min(axis=0) - margin, places.max(axis=0) + margin
    near, far = near_and_far(terrain, low, high)
    if far is not None:
        _add_far(spec, far, near, sun)
    painter = _painter(near, tracks)
    _add_ground(spec, GROUND, near, painter.paint(0), sun)
    _add_rocks(spec, terrain, low - SCENE_DETAIL.far_rocks, high + SCENE_DETAIL.far_rocks, sun)
    pose = mount or front_mount(rover)
    spec.body(rover.chassis).add_camera(name=FRONT, pos=pose.position, quat=quaternion(pose.rotation), fovy=fovy_deg)
    return spec.compile(), painter


def _painter(patch: Patch, tracks: Sequence[Track]) -> TrackPainter:
    extent = np.subtract(patch.high, patch.low)
    picture = regolith(SCENE_DETAIL.texels, float(extent.max()))
    return TrackPainter(picture, patch.low, extent.tolist(), tracks)


def toned(normal: np.ndarray, sun: Sun, mu: float) -> np.ndarray:
    """Normals (..., 3) by which OpenGL's light shows soil as bright as `Film` develops it.

    OpenGL makes the screen as bright as the cosine between normal and Sun. But soil's light grows by less, and a screen
    shows the root of light. So normals are turned towards the Sun, or away from it, until OpenGL is right.

    Args:
      normal: of faces, of length 1. sun: the light. mu: usual cosine between them and the viewer.
    """
    towards = sun.direction
    mu0 = normal @ towards
    shown = np.asarray(Film().shown(Regolith(), mu0, mu, towards[2]), float)
    from_sun = np.clip((shown / ALBEDO[0] - FILL) / sun.exposure, 0.0, 1.0)
    cosine = np.where(mu0 > 0.0, from_sun, mu0)
    aside = normal - mu0[..., None] * towards
    # Of a face towards the Sun any side will do.
    aside = np.where(np.linalg.norm(aside, axis=-1, keepdims=True) > 1e-6, aside, np.cross(towards, [1.0, 0.3, 0.2]))
    aside /= np.linalg.norm(aside, axis=-1, keepdims=True)
    return cosine[..., None] * towards + np.sqrt(1.0 - cosine**2)[..., None] * aside


def _add_ground(spec: Any, name: str, patch: Patch, picture: np.ndarray, sun: Sun, lower: Any = 0.0) -> None:
    """The patch as a mesh: MuJoCo lights meshes smoothly, and height fields triangle by triangle."""
    vertices, normals, faces, texture = _surface(patch, lower)
    normals = toned(normals, sun, METERED).astype(np.float32)
    mesh = spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    mesh.uservert, mesh.usernormal = vertices.ravel(), normals.ravel()
    mesh.userface = mesh.userfacenormal = faces.ravel()
    material = spec.add_material(name=name, rgba=[1, 1, 1, 1], specular=0.0, shininess=0.0)
    mesh.usertexcoord, mesh.userfacetexcoord = texture.ravel(), faces.ravel()
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG", compress_level=1)
    spec.assets = {**spec.assets, f"{name}.png": file.getvalue()}
    spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, file=f"{name}.png")
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    spec.worldbody.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=name, mass=0.0, contype=0, conaffinity=0
    )


def _surface(patch: Patch, lower: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, normals, triangles and texture coordinates (0, 0 at the picture's top left) of a patch."""
    z = patch.heights
    rows, cols = z.shape
    x, y = (np.linspace(a, b, n) for a, b, n in zip(patch.low, patch.high, (cols, rows), strict=True))
    north, east = np.gradient(z, y, x)
    normal = np.stack([-east, -north, np.ones_like(z)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    place = np.stack([*np.meshgrid(x, y), z - lower], axis=-1)
    u, v = np.meshgrid(np.linspace(0, 1, cols), np.linspace(1, 0, rows))
    index = np.arange(rows * cols).reshape(rows, cols)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.stack([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)], axis=2)
    flat = (place.reshape(-1, 3), normal.reshape(-1, 3), faces.reshape(-1, 3), np.stack([u, v], -1).reshape(-1, 2))
    return flat[0].astype(np.float32), flat[1].astype(np.float32), flat[2].astype(np.int32), flat[3].astype(np.float32)


def _add_far(spec: Any, far: Patch, near: Patch, sun: Sun) -> None:
    """Adds the whole terrain as a coarse mesh, lowered where the near ground covers it."""
    x, y = (np.linspace(a, b, n) for a, b, n in zip(far.low, far.high, far.heights.shape[::-1], strict=True))
    # By a share of a cell: nodes on the near ground's edge are not within it.
    spare = 0.01 * (x[1] - x[0])
    inside = [(v > a + spare) & (v < b - spare) for v, a, b in zip((x, y), near.low, near.high, strict=True)]
    hidden = inside[1][:, None] & inside[0][None, :]
    picture = regolith(SCENE_DETAIL.far_texels, float(np.subtract(far.high, far.low).max()))
    _add_ground(spec, FAR_GROUND, far, picture, sun, np.where(hidden, SCENE_DETAIL.drop, 0.0))


def _add_rocks(spec: Any, terrain: Terrain, low: np.ndarray, high: np.ndarray, sun: Sun) -> None:
    """All rocks between two corners (2,) m: meshes, whose light can be toned as the ground's is."""
    if terrain.rocks is None:
        return
    centers = np.asarray(terrain.rocks.centers, float)
    # A screen shows the root of the light, by the cameras' gamma.
    rock = ALBEDO * ROCK_BRIGHTNESS ** (1.0 / Film().gamma)
    spec.add_material(name=ROCK, rgba=[*rock, 1], specular=0.0, shininess=0.0)
    ball, faces = _ball()
    for i, (center, axes, turn) in enumerate(zip(centers, *semi_axes(terrain.rocks), strict=True)):
        if axes[0] > 0 and (center[:2] > low).all() and (center[:2] < high).all():
            normal = (ball / axes) @ turn.T
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            name = f"{ROCK}_{i}"
            mesh = spec.add_mesh(name=name)
            mesh.uservert, mesh.usernormal = ((ball * axes) @ turn.T).ravel(), toned(normal, sun, BALL).ravel()
            mesh.userface = mesh.userfacenormal = faces.ravel()
            spec.worldbody.add_geom(
                name=name,
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=name,
                pos=center,
                material=ROCK,
                contype=0,
                conaffinity=0,
            )


def _ball() -> tuple[np.ndarray, np.ndarray]:
    """Places (n, 3) on a ball of radius 1 and triangles (m, 3), as finely as MuJoCo draws its own."""
    around, up = SCENE_DETAIL.rock_slices
    turn, rise = 2.0 * np.pi * np.arange(around) / around, np.pi * np.arange(1, up) / up - 0.5 * np.pi
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    rings = [np.column_stack([np.cos(r) * ring, np.full(around, np.sin(r))]) for r in rise]
    places = np.concatenate([[[0.0, 0.0, -1.0]], *rings, [[0.0, 0.0, 1.0]]])
    first, after = np.arange(around), (np.arange(around) + 1) % around
    top = len(places) - 1
    faces = [np.stack([np.zeros(around, int), 1 + after, 1 + first], axis=-1)]
    for k in range(up - 2):
        a, b = 1 + k * around + first, 1 + k * around + after
        faces += [np.stack([a, b, b + around], axis=-1), np.stack([a, b + around, a + around], axis=-1)]
    last = 1 + (up - 2) * around
    faces.append(np.stack([last + first, last + after, np.full(around, top)], axis=-1))
    return places, np.concatenate(faces).astype(np.int32)
