"""Soil by place: grids and classes from files, their values and derivatives, and wheels that cross a border."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rasterio
from rasterio import Affine
from scipy.interpolate import RegularGridInterpolator

from lunar_mjx.backends.physics.ground import Ground
from lunar_mjx.backends.physics.soil import local_soil, uniform_soil
from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.effects.ports import Pipeline, nominal_geometry, wheel_contact, wheel_ports
from lunar_mjx.errors import UserError
from lunar_mjx.model import check_effects, make_model
from lunar_mjx.spatial import Vec3
from lunar_mjx.terrain import SoilGrids, Terrain, flat, load_terrain, soil_parameters, stack
from lunar_mjx.terrain.soil.named import BOUNDS, SOILS
from tests.effects.effects_harness import bare_context, effects_named, parameters, rover_info

SURFACE = {"width": 20.0, "height": 12.0, "cell": 0.5, "x": 1000.0, "y": -400.0}
EAST, WEST = SOILS["lete_sand"], SOILS["lunar_nominal"]
RADIUS, WIDTH = 0.25, 0.2


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def border() -> Terrain:
    """Level ground: lunar soil in the west, sand in the east, and 1 m from one to the other about x = 0."""
    west, east = (dict(s, tan_phi=np.tan(s["friction_angle"])) for s in (WEST, EAST))
    values = {k: jnp.asarray([[west[k]] * 2 + [east[k]] * 2] * 4) for k in west if k != "friction_angle"}
    at = (jnp.asarray(v) for v in (-1.5, -1.5, 1.0))
    return dataclasses.replace(flat(8.0, dtype=float), grids=SoilGrids(*at, **values))


def wheels(terrain: Terrain, x: Any, soil: Any = None) -> tuple[Any, Any]:
    """Soil under driving wheels 2 cm deep at x, and the forces on them."""
    return _wheels(terrain, jnp.asarray(x, float), soil or {})


@jax.jit
def _wheels(terrain: Terrain, x: Any, soil: Any) -> tuple[Any, Any]:
    """See `wheels`; compiled once for a kind of ground and a number of wheels."""
    zero = jnp.zeros_like(x)
    pipeline = Pipeline(effects_named(("soil", "surface_type", "pressure_sinkage", "closed_form_shear")))
    ctx = bare_context(
        terrain=terrain,
        wheel_position=Vec3(x, zero, zero + RADIUS - 0.02),
        wheel_axle=Vec3(zero, zero + 1.0, zero),
        wheel_velocity=Vec3(zero + 0.08, zero, zero),
        wheel_angular_velocity=Vec3(zero, zero + 0.1 / RADIUS, zero),
        geometry=nominal_geometry(rover_info(RADIUS + zero, WIDTH + zero)),
        parameters=parameters(pipeline.effects, {"soil": soil}),
    )
    ctx = wheel_ports(pipeline, dataclasses.replace(ctx, contact=wheel_contact(ctx)), {})[0]
    wheel: Any = ctx.wheel
    return ctx.soil, wheel.force


def test_a_wheel_that_crosses_a_border_feels_each_side():
    level = flat(8.0, dtype=float)
    here, force = wheels(border(), [-1.0, -0.5, 0.0, 0.5, 1.0])
    for side, soil in ((slice(0, 2), WEST), (slice(3, 5), EAST)):
        alone = wheels(level, [0.0], soil)[1]
        for part, wanted in zip(force, alone, strict=True):
            np.testing.assert_allclose(part[side], np.repeat(wanted, 2), rtol=1e-12)
    assert force.z[0] < force.z[2] < force.z[4] and force.z[4] > 2.0 * force.z[0]
    np.testing.assert_allclose(here.cohesion[2], 0.5 * (WEST["cohesion"] + EAST["cohesion"]))


def test_values_and_derivatives_are_those_of_the_bilinear_surface():
    rng = np.random.default_rng(3)
    nodes = {"k_phi": rng.uniform(1e5, 1e6, (6, 5)), "cohesion": rng.uniform(0.0, 900.0, (6, 5))}
    at = (-2.0, 1.0, 0.7)
    grids = SoilGrids(*map(jnp.asarray, at), **{k: jnp.asarray(v) for k, v in nodes.items()})
    x, y = rng.uniform(-2.0, 0.8, 200), rng.uniform(1.0, 4.5, 200)
    assert set(soil_parameters(grids, x, y)) == set(nodes)
    for name, values in nodes.items():
        exact = RegularGridInterpolator((1.0 + 0.7 * np.arange(6), -2.0 + 0.7 * np.arange(5)), values)
        np.testing.assert_allclose(soil_parameters(grids, x, y)[name], exact(np.stack([y, x], -1)), rtol=1e-12)
        slope = jax.vmap(jax.grad(lambda a, b, n=name: soil_parameters(grids, a, b)[n]))(jnp.asarray(x), jnp.asarray(y))
        # the patch is linear along x, so that a difference within it is exact
        cell = np.floor((x + 2.0) / 0.7)
        low, high = (exact(np.stack([y, np.clip(-2.0 + 0.7 * (cell + k), -2.0, 0.8)], -1)) for k in (0, 1))
        np.testing.assert_allclose(slope, (high - low) / 0.7, rtol=1e-9, atol=1e-6 * values.max())

    def total(nodes: Any) -> Any:
        return jnp.sum(soil_parameters(dataclasses.replace(grids, k_phi=nodes), x, y)["k_phi"])

    weights = jax.grad(total)(jnp.asarray(nodes["k_phi"]))
    # the weights of every point add up to one
    np.testing.assert_allclose(weights.sum(), len(x), rtol=1e-12)
    np.testing.assert_allclose((weights * nodes["k_phi"]).sum(), total(jnp.asarray(nodes["k_phi"])), rtol=1e-12)


def test_without_grids_the_step_is_what_it_was():
    ground, ctx = object(), SimpleNamespace(terrain=flat(), wheel_position=None)
    assert CATALOGUE["surface_type"].ports["soil"](ctx, None, None, ground) is ground
    assert len(jax.tree.leaves(flat())) == 5


def test_numpy_reads_the_same_soil():
    terrain = border()
    x = np.linspace(-3.0, 3.0, 41)
    wanted, _ = wheels(terrain, x)
    place = np.stack([x, 0.0 * x, 0.0 * x], -1)[None]
    c: Any = SimpleNamespace(
        wheel_position=place,
        ground=Ground(terrain),
        geometry={"radius": np.full((1, len(x)), RADIUS)},
        contact={"normal": np.broadcast_to([0.0, 0.0, 1.0], place.shape)},
        numbers=SimpleNamespace(effects={"surface_type": None}),
    )
    found = local_soil(c, uniform_soil(SimpleNamespace(**WEST), x[None]), ("surface_type",))
    for name in ("k_c", "k_phi", "n", "cohesion", "tan_phi", "shear_modulus_x", "shear_modulus_y"):
        np.testing.assert_allclose(found[name][0], getattr(wanted, name), rtol=1e-12)


def raster(path, bands, x=990.0, y=-394.0, cell=1.0, crs="+proj=stere +lat_0=-90 +R=1737400 +units=m"):
    """A GeoTIFF whose north-western corner lies at (x, y)."""
    bands = np.asarray(bands, np.float32)
    rows, cols = bands.shape[1:]
    size = {"count": len(bands), "height": rows, "width": cols}
    place = {"crs": crs, "transform": Affine(cell, 0, x, 0, -cell, y)}
    with rasterio.open(path, "w", driver="GTiff", dtype="float32", **size, **place) as out:
        out.write(bands)
        out.units = ["Pa"] * len(bands)
    return str(path)


def test_a_geotiff_lies_where_it_says(tmp_path):
    columns = np.tile(np.arange(20.0), (12, 1))
    path = raster(tmp_path / "soil.tif", [100.0 + columns, 0.5 + 0.01 * columns])
    made: Any = load_terrain(
        {"surface": SURFACE, "soil": {"grids": {"file": path, "layers": ["cohesion", "friction_angle"]}}}
    )
    # columns are pixels 1 m wide whose first has its middle at 990.5 on the map, the origin is at 1000
    found = soil_parameters(made.grids, jnp.asarray([-9.5, 0.5, 9.5]), jnp.zeros(3))
    np.testing.assert_allclose(found["cohesion"], [100.0, 110.0, 119.0], rtol=1e-6)
    np.testing.assert_allclose(found["tan_phi"], np.tan([0.5, 0.6, 0.69]), rtol=1e-6)
    assert set(found) == {"cohesion", "tan_phi"} and made.soil is None


def test_an_archive_lies_on_the_middle_of_the_ground(tmp_path):
    north = np.repeat([[3e6], [2e6], [1e6]], 4, axis=1)
    np.savez(tmp_path / "soil.npz", k_phi=north, rock=np.array([[1.0] * 4, [0.0] * 4, [0.0] * 4]), cell=4.0)
    spec = {"surface": SURFACE, "soil": {"grids": {"file": str(tmp_path / "soil.npz")}}}
    made: Any = load_terrain(spec)
    found = soil_parameters(made.grids, jnp.zeros(3), jnp.asarray([-4.0, 0.0, 4.0]))["k_phi"]
    np.testing.assert_allclose(found, [1e6, 2e6, 3e6], rtol=1e-6)
    assert made.soil.rock[2].min() == 1.0 and made.soil.rock[:2].max() == 0.0
    spec["soil"]["grids"]["y"] = -396.0
    again: Any = load_terrain(spec)
    moved = soil_parameters(again.grids, 0.0, jnp.asarray([4.0]))["k_phi"]
    np.testing.assert_allclose(moved, 2e6, rtol=1e-6)
    pair = stack([made, made])
    both = jax.vmap(lambda t, x: soil_parameters(t.grids, x, x))(pair, jnp.zeros(2))["k_phi"]
    np.testing.assert_allclose(both, [2e6, 2e6], rtol=1e-6)
    with pytest.raises(UserError, match=r"soil grids = .*differ"):
        stack([made, load_terrain({"surface": SURFACE})])


def test_classes_are_soils_by_number(tmp_path):
    numbers = np.array([[7.0, 7.0, 9.0, 4.0]] * 3)
    path = raster(tmp_path / "classes.tif", [numbers], cell=5.0)
    soils = {"7": "lunar_nominal", "9": {"soil": "lete_sand", "cohesion": 900.0}, "4": "rock"}
    made: Any = load_terrain({"surface": SURFACE, "soil": {"classes": {"file": path, "soils": soils}}})
    x = jnp.asarray([-7.5, 2.5, 7.5])
    found = soil_parameters(made.grids, x, 0.0 * x)
    assert len(found) == len(BOUNDS)
    np.testing.assert_allclose(found["n"], [1.0, 0.793, 0.793], rtol=1e-6)
    np.testing.assert_allclose(found["cohesion"], [170.0, 900.0, 900.0], rtol=1e-6)
    assert [float(v) for v in made.soil.rock[0]] == [0.0, 0.0, 0.0, 1.0]


def grids(**more: Any) -> dict[str, Any]:
    return {"surface": SURFACE, "soil": {"grids": {"file": "soil.npz"} | more}}


def classes(soils: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"surface": SURFACE, "soil": {"classes": {"file": "c.npy", "cell": 5.0, "soils": soils} | more}}


GOOD = {"k_phi": np.full((3, 3), 1e6), "cell": 5.0}
FULL = np.ones((3, 4))


@pytest.mark.parametrize(
    ("spec", "arrays", "parts"),
    [
        (grids(), None, ["soil.npz", "not there"]),
        (grids(), GOOD | {"k_fi": FULL[:, :3]}, ["k_fi", "no parameter", "k_phi"]),
        (grids(), GOOD | {"n": np.full((3, 3), 9.0)}, ["n = 9.0", "[0.1, 3]"]),
        (grids(), GOOD | {"n": np.full((3, 3), np.nan)}, ["n = '9 nodes'", "not finite"]),
        (grids(), GOOD | {"n": np.ones((3, 4))}, ["layers", "differ in shape"]),
        (grids(), GOOD | {"n": np.ones(3)}, ["n = 'float64 of shape (3,)'", "no grid"]),
        (grids(), {"n": FULL}, ["cell = None", "without a scale"]),
        (grids(), GOOD | {"cell": [1.0, 2.0]}, ["cell", "not one number"]),
        (grids(), {"cell": 1.0}, ["arrays", "nothing to read"]),
        (grids(cell=-1.0), {"n": FULL}, ["cell = -1.0", "not positive"]),
        (grids(layers=["n"]), GOOD, ["layers", "does not go with an archive"]),
        (grids(x=5000.0), GOOD, ["place", "beside the ground"]),
        (grids(file="soil.jpg", layers=["n"]), GOOD, ["suffix = '.jpg'", ".tif"]),
        (grids(file="c.npy", cell=5.0), FULL, ["layers = 'none'", "without a name"]),
        (grids(file="c.npy", cell=5.0, layers=["n", "n"]), FULL, ["twice"]),
        (grids(file="c.npy", cell=5.0, layers=["n", "rock"]), FULL, ["band = 2", "holds one"]),
        (grids(file="c.npy", cell=5.0, layers=["clay"]), FULL, ["layer = 'clay'", "no parameter"]),
        (grids(layers="n"), GOOD, ["soil.grids.layers", "not a list"]),
        (classes({"2": "lete_sand"}), FULL, ["class = '1'", "not in soil.classes.soils (2)"]),
        (classes({"one": "lete_sand"}), FULL, ["'one'", "no whole number"]),
        (classes({"1_0": "lete_sand"}), FULL, ["'1_0'", "no whole number"]),
        (classes({"9" * 400: "lete_sand"}), FULL, ["'999", "no whole number"]),
        (classes({"1": "mud"}), FULL, ["soils.1 = 'mud'", "lete_sand"]),
        (classes({"1": {"cohesion": 5.0}}), FULL, ["soils.1", "lacks k_c, k_phi, n"]),
        (classes({"1": {"soil": "marssim", "cohesion": -5.0}}), FULL, ["soils.1.cohesion", "outside"]),
        (classes({"1": {"soil": "marssim", "clay": 1.0}}), FULL, ["clay", "no parameter"]),
        (classes({"1": "rock"}), np.where(np.eye(3, 4) > 0, np.nan, 1.0), ["3 of 12", "not finite"]),
        ({"surface": SURFACE, "soil": {}}, None, ["soil", "says nothing"]),
        (
            {"surface": SURFACE, "soil": classes({})["soil"] | grids()["soil"]},
            None,
            ["soil.classes", "does not go with"],
        ),
        (
            {"surface": SURFACE, "soil": grids()["soil"] | {"rock_fraction": 0.1}},
            GOOD | {"rock": np.zeros((3, 3))},
            ["rock", "soil.rock_fraction"],
        ),
    ],
)
def test_bad_input_gets_one_sentence(tmp_path, monkeypatch, spec, arrays, parts):
    monkeypatch.chdir(tmp_path)
    if isinstance(arrays, dict):
        np.savez("soil.npz", **arrays)
    elif arrays is not None:
        np.save("c.npy", arrays)
    with pytest.raises(UserError) as caught:
        load_terrain(spec)
    text = str(caught.value)
    assert "\n" not in text and text.endswith("."), text
    for part in parts:
        assert part in text, text


def test_broken_archive(tmp_path):
    (tmp_path / "soil.npz").write_bytes(b"no archive")
    with pytest.raises(UserError, match="cannot be read"):
        load_terrain(grids(file=str(tmp_path / "soil.npz")))


def test_soil_that_pulls_wheels_down_is_refused():
    bad = SoilGrids(*map(jnp.asarray, (-1.0, -1.0, 1.0)), k_c=jnp.full((3, 3), -1e6))
    with pytest.raises(
        UserError, match=r"test: soil grids of flat: effects\.soil\.k_c = '-1e\+06 to -1e\+06'.*not positive"
    ):
        check_effects(make_model("luvmi_x", dataclasses.replace(flat(), grids=bad)), "test")
