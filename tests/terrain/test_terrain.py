"""Terrains by name, table and file; batches; meshes."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rasterio
import trimesh

from lunar_mjx.errors import UserError
from lunar_mjx.terrain import (
    Dem,
    export_mesh,
    flat,
    height,
    inclined,
    inside,
    load_terrain,
    make_surface,
    nearest_rock,
    rock_fraction,
    sample,
    slope,
    stack,
    to_mesh,
)

SMALL = {
    "surface": {"width": 12.0, "height": 8.0, "cell": 0.2, "roughness": {"hurst": 0.7}, "craters": {"largest": 3}},
    "rocks": {"abundance": 0.03, "clear": 1.0},
    "soil": {"rock_fraction": 0.3, "patch": 2.0},
}


def test_planes_are_exact():
    terrain = inclined(np.radians(10.0), extent=100.0, direction=np.radians(30.0))
    x, y = np.random.default_rng(0).uniform(-49, 49, (2, 200))
    z, dzdx, dzdy = sample(terrain.field, x, y)
    rise = np.tan(np.radians(10.0))
    np.testing.assert_allclose(z, rise * (np.cos(np.pi / 6) * x + 0.5 * y), atol=2e-5)
    np.testing.assert_allclose(np.arctan(np.hypot(dzdx, dzdy)), np.radians(10.0), rtol=1e-4)
    assert float(slope(terrain.field, 3.0, 4.0)) == pytest.approx(np.radians(10.0), rel=1e-4)
    assert not bool(inside(terrain.field, 51.0, 0.0))
    assert float(height(flat().field, 3.3, -99.0)) == 0.0


def test_shipped_terrains_load_at_true_scale():
    plain = load_terrain("lunar_plain")
    field = plain.field
    assert field.heights.shape == (801, 801) and float(field.cell) == pytest.approx(0.1)
    assert plain.rocks is not None and 24 <= int((plain.rocks.radii > 0).sum()) <= 100
    x, y = np.random.default_rng(0).uniform(-40, 40, (2, 5000))
    degrees = np.degrees(np.asarray(slope(field, x, y)))
    assert 1 < np.median(degrees) < 5 and 10 < np.percentile(degrees, 99) < 20
    assert abs(float(height(field, 0.0, 0.0))) <= 0.6  # the origin is near the ground
    assert float(nearest_rock(plain.rocks, 0.0, 0.0)[3]) == 0.0
    assert load_terrain("flat").name == "flat"
    assert float(slope(load_terrain("slope:-7.5deg").field, 0.5, 0.5)) == pytest.approx(np.radians(7.5), rel=1e-4)


@pytest.fixture(scope="module")
def surface_once():
    """`make_surface` that makes the ten million heights of the stand-in once for all tests of this file."""
    kept = {}

    def make(*given, **named):
        key = repr((given, sorted(named.items())))
        if key not in kept:
            kept[key] = make_surface(*given, **named)
        return kept[key]

    yield make
    assert len(kept) == 1, "tests ask for one and the same surface"


def test_stand_in_has_the_statistics_of_the_site(surface_once):
    from lunar_mjx.resources import find
    from lunar_mjx.terrain.config import read_config
    from lunar_mjx.terrain.roughness import hurst_exponent

    table = read_config(find("terrain", "de_gerlache_rim", "terrain.toml") / "terrain.toml").surface
    assert table is not None
    dem = surface_once(
        table.width,
        table.height,
        table.cell,
        1,
        roughness=table.roughness,
        craters=table.craters,
        center=(table.x, table.y),
    )
    # The product's own grid: pixel centres from -44997.5 and 7002.5 m, 3200 of them.
    assert dem.heights.shape == (3200, 3200) and (dem.x0, dem.y0) == (-44997.5, 7002.5)
    north, east = np.gradient(dem.heights[::2, ::2], 10.0)
    assert 0.04 < (np.hypot(north, east) > np.tan(np.radians(20))).mean() < 0.12
    assert hurst_exponent(dem.heights[:1600:2, :1600:2], 10.0) == pytest.approx(0.95, abs=0.1)
    windows = [np.ptp(dem.heights[i : i + 500, j : j + 500]) for i in range(0, 2600, 500) for j in range(0, 2600, 500)]
    assert 300 < np.median(windows) < 600


@pytest.fixture
def site(tmp_path):
    """A GeoTIFF like the product's, over the part that the configuration crops."""
    rng = np.random.default_rng(0)
    path = tmp_path / "Site11_final_adj_5mpp_surf.tif"
    transform = rasterio.Affine(5, 0, -37450, 0, -5, 13450)
    crs = "+proj=stere +lat_0=-90 +lon_0=0 +k=1 +x_0=0 +y_0=0 +R=1737400 +units=m +no_defs"
    with rasterio.open(
        path, "w", driver="GTiff", height=60, width=60, count=1, dtype="float32", crs=crs, transform=transform
    ) as raster:
        raster.write((600 + rng.normal(size=(60, 60))).astype("float32"), 1)
    return path


def test_the_stand_in_says_that_it_is_one(caplog, surface_once, monkeypatch):
    monkeypatch.setattr("lunar_mjx.terrain.load.make_surface", surface_once)
    terrain = load_terrain("de_gerlache_rim")
    assert terrain.name == "de_gerlache_rim (stand-in)" and "LUNAR_MJX_DEM_DE_GERLACHE_RIM" in caplog.text
    assert terrain.origin[0] == pytest.approx(-37300, abs=3) and min(terrain.field.heights.shape) > 490
    x, y = np.random.default_rng(0).uniform(-50, 50, (2, 2000))
    assert 2 < float(np.degrees(np.median(slope(terrain.field, x, y)))) < 12  # ground that a rover can drive on


@pytest.mark.parametrize("by", ["argument", "environment"])
def test_the_users_dem_replaces_the_stand_in(site, by, monkeypatch):
    if by == "environment":
        monkeypatch.setenv("LUNAR_MJX_DEM_DE_GERLACHE_RIM", str(site))
    terrain = load_terrain("de_gerlache_rim", dem=site if by == "argument" else None)
    assert terrain.name == "de_gerlache_rim" and terrain.origin[2] == pytest.approx(600, abs=4)
    assert terrain.origin[0] == pytest.approx(-37300, abs=3) and terrain.origin[1] == pytest.approx(13300, abs=3)
    assert float(terrain.field.cell) == pytest.approx(0.2) and min(terrain.field.heights.shape) > 490
    bare = load_terrain(str(site))
    assert bare.field.heights.shape == (60, 60) and bare.rocks is None


def test_toml_file_with_a_dem_beside_it(site, tmp_path):
    (tmp_path / "mine.toml").write_text(f'[dem]\nfile = "{site.name}"\n')
    assert load_terrain(tmp_path / "mine.toml").name == "mine"
    folder = tmp_path / "here"
    folder.mkdir()
    (folder / "terrain.toml").write_text("[plane]\nslope_deg = 5\n")
    assert load_terrain(folder).name == "here"


def test_seed_and_dtype():
    a, b, c = (load_terrain(SMALL, seed=s).field.heights for s in (1, 1, 2))
    assert (a == b).all() and not (a == c).all()
    with jax.enable_x64(True):
        terrain = load_terrain(SMALL, dtype=np.float64)
        assert {leaf.dtype.name for leaf in jax.tree.leaves(terrain)} == {"float64", "int32"}


def test_rocks_stand_on_the_ground():
    terrain = load_terrain(SMALL)
    assert terrain.rocks is not None
    centers, radii = np.asarray(terrain.rocks.centers), np.asarray(terrain.rocks.radii)
    centers, radii = centers[radii > 0], radii[radii > 0]
    assert len(radii) > 0
    ground = height(terrain.field, centers[:, 0], centers[:, 1])
    np.testing.assert_allclose(centers[:, 2] + radii - ground, 1.2 * radii, atol=1e-4)


def test_soil_map():
    terrain = load_terrain(SMALL)
    x, y = np.random.default_rng(0).uniform(-1, 1, (2, 4000)) * [[6.0], [4.0]]
    rock = np.asarray(rock_fraction(terrain.soil, x, y))
    assert rock.min() >= 0 and rock.max() <= 1 and rock.mean() == pytest.approx(0.3, abs=0.05)
    assert (rock_fraction(None, x, y) == 0).all()


def test_stack_is_a_batch_for_vmap():
    terrains = [load_terrain(SMALL, seed=s) for s in (1, 2)]
    bare = load_terrain({"surface": SMALL["surface"]}, seed=3)
    batch = stack([*terrains, bare])
    assert batch.field.heights.shape == (3, 41, 61)
    x, y = jnp.asarray(np.random.default_rng(0).uniform(-4, 4, (2, 50)), jnp.float32)

    @jax.jit
    @jax.vmap
    def everything(t):
        return sample(t.field, x, y), nearest_rock(t.rocks, x, y), rock_fraction(t.soil, x, y), inside(t.field, x, y)

    ground, rocks, soil, within = everything(batch)
    for k, t in enumerate([*terrains, bare]):
        np.testing.assert_allclose(ground[0][k], sample(t.field, x, y)[0], atol=1e-6)
        radius = nearest_rock(t.rocks, x, y)[3]
        np.testing.assert_allclose(rocks[3][k], radius, atol=1e-6)
        np.testing.assert_allclose(np.where(radius > 0, rocks[0][k] - nearest_rock(t.rocks, x, y)[0], 0), 0, atol=1e-6)
        np.testing.assert_allclose(soil[k], rock_fraction(t.soil, x, y), atol=1e-6)
    assert bool(within.all())


def test_terrains_of_other_seeds_do_not_compile_again():
    count = 0

    @jax.jit
    def step(t):
        nonlocal count
        count += 1
        return height(t.field, 0.1, 0.2)

    bare = {"surface": SMALL["surface"]}
    for seed in range(3):
        step(load_terrain(bare, seed=seed))
    assert count == 1


def test_stack_refuses_what_does_not_fit():
    with pytest.raises(UserError, match="empty"):
        stack([])
    with pytest.raises(UserError, match="does not agree"):
        stack([flat(10.0), flat(20.0)])


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply"])
def test_mesh_roundtrip_keeps_the_heights(tmp_path, suffix):
    terrain = dataclasses.replace(load_terrain(SMALL), rocks=None)
    mesh = trimesh.load(export_mesh(terrain, tmp_path / f"t{suffix}"), force="mesh")
    vertices = np.asarray(mesh.vertices)
    assert len(np.unique(vertices.round(4), axis=0)) == terrain.field.heights.size
    z = height(terrain.field, jnp.asarray(vertices[:, 0], jnp.float32), jnp.asarray(vertices[:, 1], jnp.float32))
    np.testing.assert_allclose(vertices[:, 2], z, atol=2e-5)
    assert (mesh.face_normals[:, 2] > 0).all()


def test_solid_mesh_is_watertight_and_has_the_volume():
    terrain = load_terrain(SMALL)
    ground = to_mesh(terrain, rocks=False, solid=True, depth=0.5)
    assert ground.is_watertight and ground.is_winding_consistent
    z = np.asarray(terrain.field.heights, float)
    floor = z.min() - 0.5
    expected = 0.25 * (z[1:, 1:] + z[1:, :-1] + z[:-1, 1:] + z[:-1, :-1] - 4 * floor).sum() * 0.2**2
    assert ground.volume == pytest.approx(expected, rel=1e-3)
    assert terrain.rocks is not None
    both = to_mesh(terrain, solid=True)
    assert both.is_watertight and both.body_count == 1 + int((terrain.rocks.radii > 0).sum())


def test_dem_terrain_from_apollo_15(apollo15, tmp_path):
    (tmp_path / "terrain.toml").write_text(
        f'[dem]\nfile = "{apollo15}"\ncell = 2.0\nheight_scale = 49.0\n'
        "[crop]\nx = 200\ny = 200\nwidth = 60\nheight = 60\n"
        "[detail]\ncell = 0.2\n[detail.roughness]\nhurst = 0.75\n"
    )
    terrain = load_terrain(tmp_path)
    assert isinstance(terrain.origin, jax.Array) and terrain.field.heights.shape == (301, 301)
    assert Dem(np.zeros((2, 2)), 1.0).heights.shape == (2, 2)
