"""Terrains as triangle meshes (STL, OBJ, PLY) for tools that know no height fields."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.files import replacing
from lunar_mjx.terrain.rocks import semi_axes
from lunar_mjx.terrain.terrain import Terrain

SUFFIXES = (".stl", ".obj", ".ply")


def to_mesh(terrain: Terrain, *, rocks: bool = True, solid: bool = False, depth: float = 1.0) -> trimesh.Trimesh:
    """Makes a mesh whose vertices are the nodes of the height field.

    Between the nodes it is not the bilinear surface of the simulator but two triangles a cell; they differ by a quarter
    of the cell's twist at most.

    Args:
      terrain: one terrain, not a batch.
      rocks: adds the rocks as closed icospheres, stretched where they are ellipsoids.
      solid: closes the ground by walls and a floor, so that the mesh is watertight.
      depth: of the floor below the lowest node, m.

    Returns:
      The mesh in the terrain's frame, m.
    """
    field = terrain.field
    if field.heights.ndim != 2:
        raise bad_input(
            terrain.name, "heights", f"{field.heights.ndim} axes", "are a batch", "export one terrain of it"
        )
    if solid and depth <= 0:
        raise bad_input(terrain.name, "depth", depth, "is not positive", "give the floor's depth in m")
    # Meshes are closed by sums of heights and a depth; float32 would leave slits.
    heights = np.asarray(field.heights, np.float64)
    rows, cols = heights.shape
    x = float(field.x0) + np.arange(cols) * float(field.cell)
    y = float(field.y0) + np.arange(rows) * float(field.cell)
    vertices = np.stack([*np.meshgrid(x, y), heights], axis=-1).reshape(-1, 3)
    node = np.arange(rows * cols).reshape(rows, cols)
    faces = _quads(node[:-1, :-1], node[:-1, 1:], node[1:, 1:], node[1:, :-1])
    if solid:
        vertices, faces = _closed(vertices, faces, node, heights.min() - depth)
    bodies = [trimesh.Trimesh(vertices, faces, process=False)]
    if rocks and terrain.rocks is not None:
        for center, axes, turn in zip(np.asarray(terrain.rocks.centers), *semi_axes(terrain.rocks), strict=True):
            # Dummies of the look-up have radius 0.
            if axes[0] > 0:
                # 320 faces: 2 % of the radius from the sphere at most, below what a wheel feels.
                body = trimesh.creation.icosphere(subdivisions=2)
                body.vertices = body.vertices * axes @ turn.T + center.astype(np.float64)
                bodies.append(body)
    if len(bodies) == 1:
        return bodies[0]
    starts = np.cumsum([0] + [len(body.vertices) for body in bodies[:-1]])
    return trimesh.Trimesh(
        np.concatenate([body.vertices for body in bodies]),
        np.concatenate([body.faces + start for body, start in zip(bodies, starts, strict=True)]),
        process=False,
    )


def _quads(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Two triangles for each quadrilateral, counterclockwise seen from outside."""
    return np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])


def _closed(vertices: np.ndarray, faces: np.ndarray, node: np.ndarray, floor: float) -> tuple[np.ndarray, np.ndarray]:
    """Adds walls around the rim and a fan of triangles below."""
    rim = np.concatenate([node[0, :-1], node[:-1, -1], node[-1, :0:-1], node[:0:-1, 0]])  # counterclockwise from above
    count = len(vertices)
    foot = vertices[rim] * [1, 1, 0] + [0, 0, floor]
    middle = np.append(foot[:, :2].mean(axis=0), floor)
    # The floor is a fan about its middle, which any rectangle's outline allows.
    below, beside = count + np.arange(len(rim)), np.roll(np.arange(len(rim)), -1)
    walls = _quads(rim, below, below[beside], rim[beside])
    fan = np.stack([below[beside], below, np.full(len(rim), count + len(rim))], -1)
    return np.vstack([vertices, foot, middle]), np.concatenate([faces, walls, fan])


def export_mesh(terrain: Terrain, path: str | Path, **options: Any) -> Path:
    """Writes a terrain as STL, OBJ or PLY by the path's suffix; options as for `to_mesh`.

    Raises:
      UserError: another suffix, or a folder that does not exist.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise bad_input(path, "suffix", path.suffix, "is not a mesh format", f"use one of {', '.join(SUFFIXES)}")
    if not path.parent.is_dir():
        raise UserError(f"{path}: the folder is not there; make it first.")
    with replacing(path) as part:
        data: Any = to_mesh(terrain, **options).export(file_type=path.suffix[1:].lower())
        part.write_bytes(data.encode() if isinstance(data, str) else data)
    return path
