"""The laws of reflection against Hapke's formulas written down once more, and against what they must obey."""

from __future__ import annotations

import numpy as np
import pytest

from lunar_mjx.cameras import Film, Regolith
from lunar_mjx.errors import UserError

SOIL = Regolith()


def hapke(s: Regolith, i: float, e: float, g: float) -> float:
    """I/F by eqs. 2 of Sato et al. 2014 without roughness, from angles in rad and in float64."""
    mu0, mu = np.cos(i), np.cos(e)
    p = 0.5 * (1 + s.back) * (1 - s.lobe**2) / (1 - 2 * s.lobe * np.cos(g) + s.lobe**2) ** 1.5
    p += 0.5 * (1 - s.back) * (1 - s.lobe**2) / (1 + 2 * s.lobe * np.cos(g) + s.lobe**2) ** 1.5
    surge = s.surge / (1 + np.tan(g / 2) / s.surge_width)
    gamma = np.sqrt(1 - s.albedo)
    h0, h = ((1 + 2 * x) / (1 + 2 * x * gamma) for x in (mu0, mu))
    return np.pi * s.albedo / (4 * np.pi) * mu0 / (mu0 + mu) * (p * (1 + surge) + h0 * h - 1)


@pytest.mark.parametrize(
    "angles", [(0.3, 0.5, 0.7), (1.2, 0.1, 1.2), (0.0, 0.0, 0.0), (1.4, 1.3, 2.4), (0.5, 0.5, 0.02)]
)
def test_hapke(angles: tuple[float, float, float]) -> None:
    found = float(SOIL.radiance_factor(np.cos(angles[0]), np.cos(angles[1]), np.cos(angles[2])))
    assert found == pytest.approx(hapke(SOIL, *angles), rel=2e-4)


@pytest.mark.parametrize("law", ["hapke", "lommel_seeliger"])
def test_light_and_viewer_may_change_places(law: str) -> None:
    """Helmholtz: I/F over the cosine of incidence is symmetric."""
    soil = Regolith(law=law)
    a, b, g = 0.83, 0.21, 0.4
    there, back = soil.radiance_factor(a, b, g) / a, soil.radiance_factor(b, a, g) / b
    assert float(there) == pytest.approx(float(back), rel=1e-5)


def test_the_moon_brightens_towards_opposition_faster_than_its_phase_function() -> None:
    near, far = (float(SOIL.radiance_factor(1.0, 1.0, np.cos(np.radians(g)))) for g in (0.0, 10.0))
    plain = Regolith(surge=0.0)
    near_, far_ = (float(plain.radiance_factor(1.0, 1.0, np.cos(np.radians(g)))) for g in (0.0, 10.0))
    assert near / far > 1.3 and near_ / far_ < 1.05


def test_lambert_is_as_bright_where_it_is_matched() -> None:
    board = Regolith(law="lambert")
    assert float(board.radiance_factor(0.5, 1.0, 0.5)) == pytest.approx(float(SOIL.radiance_factor(0.5, 1.0, 0.5)))
    assert float(board.radiance_factor(1.0, 0.3, 0.2)) == pytest.approx(2 * float(board.radiance_factor(0.5, 1.0, 0.5)))


def test_what_faces_away_is_dark() -> None:
    for law in ("hapke", "lommel_seeliger", "lambert"):
        assert float(Regolith(law=law).radiance_factor(-0.2, 0.5, 0.1)) == 0.0


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Regolith(law="phong"), ("law", "phong", "hapke")),
        (lambda: Regolith(albedo=1.2), ("albedo", "1.2")),
        (lambda: Regolith(surge_width=0.0), ("surge_width", "not positive")),
        (lambda: Film(gamma=0.0), ("gamma", "not positive")),
        (lambda: Film(dust=1.0), ("dust", "[0, 1)")),
        (lambda: Film(read_noise=-1.0), ("read_noise", "negative")),
        (lambda: Film(exposure=float("nan")), ("exposure",)),
    ],
)
def test_nonsense_is_refused(make, words: tuple[str, ...]) -> None:
    with pytest.raises(UserError) as refused:
        make()
    assert all(word in str(refused.value) for word in words)
