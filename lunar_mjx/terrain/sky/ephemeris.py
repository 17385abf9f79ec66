"""The Sun over a place on the Moon at a date, from astropy's built-in ephemeris, which needs no download."""

from __future__ import annotations

from typing import Any

import numpy as np

from lunar_mjx.errors import UserError, bad_input

FIRST_YEAR, LAST_YEAR = 1900, 2100
"""Years that the built-in ephemeris covers (ERFA, `epv00`)."""
_ARGUMENTS = (
    (125.045, -0.0529921),
    (250.089, -0.1059842),
    (260.008, 13.0120009),
    (176.625, 13.3407154),
    (357.529, 0.9856003),
    (311.589, 26.4057084),
    (134.963, 13.0649930),
    (276.617, 0.3287146),
    (34.226, 1.7484877),
    (15.134, -0.1589763),
    (119.743, 0.0036096),
    (239.961, 0.1643573),
    (25.053, 12.9590088),
)
"""Arguments E1 to E13, deg and deg per day since J2000."""
_ASCENSION = {1: -3.8787, 2: -0.1204, 3: 0.0700, 4: -0.0172, 6: 0.0072, 10: -0.0052, 13: 0.0043}
_DECLINATION = {1: 1.5419, 2: 0.0239, 3: -0.0278, 4: 0.0068, 6: -0.0029, 7: 0.0009, 10: 0.0008, 13: -0.0009}
_SPIN = {
    1: 3.5610,
    2: 0.1208,
    3: -0.0642,
    4: 0.0158,
    5: 0.0252,
    6: -0.0066,
    7: -0.0047,
    8: -0.0046,
    9: 0.0028,
    10: 0.0052,
    11: 0.0040,
    12: 0.0019,
    13: -0.0044,
}
"""Amplitudes, deg, of sin E, cos E and sin E in the pole's right ascension and declination and the prime meridian."""


def sun_over(date: str, seconds: Any, latitude_deg: float, longitude_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Direction and distance of the Sun as seen from a place on the Moon.

    Args:
      date: UTC of second 0, such as "2027-11-23T06:00:00".
      seconds: after it, (times,) s.
      latitude_deg, longitude_deg: selenographic, mean Earth/polar axis, positive to the north and east.

    Returns:
      Unit vectors, east, north and up, (times, 3); distance, au. Light time and aberration (0.006 deg) are left out.

    Raises:
      UserError: astropy is not installed, or the date cannot be read.
    """
    try:
        # an extra, which the type checker's environment may lack
        from astropy import units  # pyright: ignore[reportMissingImports]
        from astropy.coordinates import get_body_barycentric  # pyright: ignore[reportMissingImports]
        from astropy.time import Time, TimeDelta  # pyright: ignore[reportMissingImports]
        from astropy.utils import iers  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise UserError(
            'a Sun with a date needs astropy, which is not installed; run pip install "lunar-mjx[sky]", or give '
            "azimuth_deg and elevation_deg."
        ) from None
    try:
        start = Time(date, scale="utc")
    except ValueError:
        raise bad_input("sun", "date", date, "is no date", 'write it as "2027-11-23T06:00:00", in UTC') from None
    if not FIRST_YEAR <= start.jyear <= LAST_YEAR:
        problem = f"is outside the years {FIRST_YEAR} to {LAST_YEAR} of the ephemeris"
        raise bad_input("sun", "date", date, problem, "give a date within them")
    # the Earth's rotation, for which tables would be fetched, plays no part
    with iers.conf.set_temp("auto_download", False):
        times = start.tdb + TimeDelta(np.asarray(seconds, float), format="sec")
        sun, moon = (
            get_body_barycentric(b, times, ephemeris="builtin").xyz.to_value(units.au) for b in ("sun", "moon")
        )
    # Days since J2000, from which the IAU's series count.
    towards = _body_fixed(sun - moon, times.jd - 2451545.0)
    distance = np.linalg.norm(towards, axis=0)
    phi, lam = np.radians(latitude_deg), np.radians(longitude_deg)
    up = np.array([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)])
    east = np.array([-np.sin(lam), np.cos(lam), 0.0])
    return (np.stack([east, np.cross(up, east), up]) @ (towards / distance)).T, distance


def _body_fixed(vector: np.ndarray, days: np.ndarray) -> np.ndarray:
    """ICRF vectors (3, times) in the Moon's mean Earth/polar axis frame, by the IAU's rotation model.

    Source: Archinal et al. 2018, Celest. Mech. Dyn. Astron. 130:22, table 2: within 150 m on the ground, 0.005 deg.
    """
    angle = np.radians([a + b * days for a, b in _ARGUMENTS])

    def series(terms: dict[int, float], wave: Any) -> Any:
        return sum(size * wave(angle[k - 1]) for k, size in terms.items())

    # The pole's drift counts by Julian centuries, the spin by days.
    centuries = days / 36525.0
    ascension = 269.9949 + 0.0031 * centuries + series(_ASCENSION, np.sin)
    declination = 66.5392 + 0.0130 * centuries + series(_DECLINATION, np.cos)
    spin = 38.3213 + 13.17635815 * days - 1.4e-12 * days**2 + series(_SPIN, np.sin)
    x, y, z = vector
    # Pole and meridian as the IAU defines them: R_z(W) R_x(90 deg - delta) R_z(90 deg + alpha).
    for turn, about_z in ((90.0 + ascension, True), (90.0 - declination, False), (spin, True)):
        cos, sin = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        if about_z:
            x, y = cos * x + sin * y, -sin * x + cos * y
        else:
            y, z = cos * y + sin * z, -sin * y + cos * z
    return np.stack([x, y, z])
