"""Sand that goes with wheels: what moves, what is held, and that what is left behind is found again."""

from __future__ import annotations

import numpy as np

from lunar_mjx.wheel_bed.particles.columns import Columns, Grains


def columns(seed: int = 0) -> Columns:
    return Columns(0.025, 2, 4, reach=0.1, rim=0.05, seed=seed)


def at(bed: Columns, grains: Grains, *wheels: tuple[float, float]) -> Grains:
    assert bed.near(np.array(wheels))
    return bed.exchange(grains)


def kept(bed: Columns) -> int:
    return sum(len(p) for p in bed.kept.values())


def test_sand_near_a_wheel_moves_and_sand_around_it_is_held():
    bed = columns()
    grains = at(bed, Grains.none(), (0.31, -0.19))
    distance = np.hypot(grains.place[:, 0] - 0.3125, grains.place[:, 1] + 0.1875)
    cell = 0.025 * np.sqrt(0.5)
    assert distance[~grains.held].max() < 0.1 + cell and distance[grains.held].min() > 0.1 - cell
    assert distance.max() < 0.15 + cell and grains.held.any()
    # Held sand lies all around: each moving column's eight neighbours are computed.
    moving, every = set(bed.number(grains.place[~grains.held]).tolist()), set(bed.number(grains.place).tolist())
    around = {
        bed.number(bed.middle(np.array([n])) + 0.025 * np.array([[i, j]]))[0]
        for n in moving
        for i in (-1, 1)
        for j in (-1, 1)
    }
    assert around <= every
    # A lattice moved by 0.4 spacings at most fills its box, and its surface is the plane.
    assert grains.place[:, 2].min() >= -0.1 and -0.0125 < grains.place[:, 2].max() <= 0.0
    assert len(grains.place) == len(every) * 4 * 8


def test_nothing_changes_within_a_voxel():
    bed = columns()
    at(bed, Grains.none(), (0.001, 0.001))
    assert not bed.near(np.array([[0.025, 0.003]])) and bed.near(np.array([[0.026, 0.008]]))


def test_ruts_are_found_again_and_no_particle_is_lost():
    bed = columns()
    grains = at(bed, Grains.none(), (0.0, 0.0))
    rut = grains.place.copy()
    rut[~grains.held, 2] -= 0.01
    grains = Grains(rut, grains.velocity, grains.gradient, grains.held)
    before = np.sort(rut.view("f4,f4,f4").ravel())
    away = at(bed, grains, (1.0, 0.0))
    assert kept(bed) == len(rut) and away.place[:, 2].min() >= -0.1
    back = at(bed, away, (0.0, 0.0))
    assert np.array_equal(np.sort(back.place.view("f4,f4,f4").ravel()), before)
    assert kept(bed) == len(away.place) and not back.velocity.any()
    depth = bed.surface(back)
    assert depth[np.hypot(depth[:, 0], depth[:, 1]) < 0.05, 2].max() < -0.01


def test_a_particle_that_flowed_out_of_the_patch_stays_in_the_world():
    bed = columns()
    grains = at(bed, Grains.none(), (0.0, 0.0))
    grains.place[0] = (0.4, 0.0, -0.01)
    moved = at(bed, grains, (0.05, 0.0))
    assert kept(bed) > 0
    here = at(bed, moved, (0.4, 0.0))
    assert np.any(np.all(here.place == np.float32([0.4, 0.0, -0.01]), axis=1))


def test_strewn_sand_is_the_same_whichever_way_a_wheel_comes():
    direct = at(columns(), Grains.none(), (0.5, 0.0))
    bed = columns()
    passing = at(bed, at(bed, Grains.none(), (0.4, 0.0)), (0.5, 0.0))
    assert np.array_equal(np.sort(direct.place, axis=0), np.sort(passing.place, axis=0))
    other = at(columns(1), Grains.none(), (0.5, 0.0))
    assert not np.array_equal(np.sort(direct.place, axis=0), np.sort(other.place, axis=0))


def test_a_bed_goes_on_from_its_state():
    bed = columns()
    away = at(bed, at(bed, Grains.none(), (0.0, 0.0)), (0.5, 0.0))
    again = columns()
    again.restore(bed.state())
    assert kept(again) == kept(bed)
    back, same = at(bed, away, (0.02, 0.3)), at(again, away, (0.02, 0.3))
    assert np.array_equal(np.sort(back.place, axis=0), np.sort(same.place, axis=0)) and kept(again) == kept(bed)


def test_room_for_what_crowds():
    bed = columns()
    grains = at(bed, Grains.none(), (0.0, 0.0))
    assert bed.most_particles == int(1.2 * len(grains.place))
