"""A test bed with errors: readings of a case, noise of four kinds, and the log that a user would hand over."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .cases import Case, Errors, generator
from .wheel import Rows, World, run

COLUMNS = {
    "drawbar_pull": "drawbar_pull_N",
    "side_force": "side_force_N",
    "driving_torque": "driving_torque_Nm",
    "sinkage": "sinkage_m",
}
STUDENT_FREEDOM = 4.0


def imposed(rows: Rows, errors: Errors) -> Rows:
    """What the bed does when it is asked for `rows`."""
    slip = np.clip(rows.slip + errors.slip, -0.97, 0.97)
    return rows._replace(slip=slip, angle=rows.angle + errors.angle, load=rows.load * (1.0 + errors.load))


def readings(world: World, rows: Rows, errors: Errors) -> dict[str, np.ndarray]:
    """Readings without noise, by quantity."""
    true = run(world, imposed(rows, errors))
    gauge = dict(errors.scale)
    if e := world.has("channel_scale"):
        gauge |= {q: (1.0 + gauge[q]) * (1.0 + e["force"]) - 1.0 for q in ("drawbar_pull", "side_force")}
        gauge["driving_torque"] = (1.0 + gauge["driving_torque"]) * (1.0 + e["torque"]) - 1.0
    pull = true.drawbar_pull + errors.cross_talk * true.side_force
    values = {
        "drawbar_pull": pull,
        "side_force": true.side_force,
        "driving_torque": true.driving_torque,
        "sinkage": true.sinkage,
    }
    return {q: (1.0 + gauge[q]) * v for q, v in values.items()}


def deviation(errors: Errors, quantity: str, values: np.ndarray) -> np.ndarray:
    """Standard deviation of one run at each row, SI units."""
    return np.hypot(errors.std[quantity], errors.share * values)


def noise(rng: np.random.Generator, errors: Errors, std: np.ndarray) -> np.ndarray:
    """Noise of one pass through a table."""
    count = len(std)
    if errors.noise == "student":
        return std * rng.standard_t(STUDENT_FREEDOM, count) / np.sqrt(STUDENT_FREEDOM / (STUDENT_FREEDOM - 2.0))
    white = rng.normal(size=count)
    if errors.noise == "ar1":
        for i in range(1, count):
            white[i] = errors.memory * white[i - 1] + np.sqrt(1.0 - errors.memory**2) * white[i]
    return std * white


def write(case: Case, folder: Path, misjudged: float = 1.0) -> list[Path]:
    """Writes a case's logs.

    Args:
      case: what to measure. folder: of the case; one log lies in it, or a campaign of them where there are several.
      misjudged: factor of all stated standard deviations, for twins that differ in nothing else.

    Returns:
      Folders of the logs.
    """
    logs = []
    for place, rows in enumerate(case.rows):
        log = folder if len(case.rows) == 1 else folder / f"gravity_{place}"
        log.mkdir(parents=True, exist_ok=True)
        _write_log(case, rows, place, log, misjudged)
        logs.append(log)
    return logs


def _write_log(case: Case, rows: Rows, place: int, log: Path, misjudged: float) -> None:
    rng = generator(case.seed, case.name, "noise", place)
    clean = readings(case.world, rows, case.errors)
    lines = [
        ",".join(
            [
                "slip_ratio",
                "slip_angle_deg",
                "normal_load_N",
                "travel_speed_m_s",
                *(COLUMNS[q] for q in case.measured),
                "trial",
            ]
        )
    ]
    for trial in range(case.replicates):
        noisy = [clean[q] + noise(rng, case.errors, deviation(case.errors, q, clean[q])) for q in case.measured]
        for i in range(len(rows.slip)):
            cells = [
                f"{rows.slip[i]:.4g}",
                f"{np.degrees(rows.angle[i]):.4g}",
                f"{rows.load[i]:.6g}",
                f"{rows.travel[i]:.6g}",
                *(f"{v[i]:.7g}" for v in noisy),
                str(trial + 1),
            ]
            lines.append(",".join(cells))
    (log / "points.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    text = [
        'format = "lunar-mjx-log/1"',
        'kind = "steady_state"',
        'file = "points.csv"',
        'slip_definition = "wheel_frame"',
        f"gravity_m_s2 = {rows.gravity[0]:.6g}",
        'split = "fit"',
        "",
        "[wheel]",
        f"radius_m = {case.world.radius:.6g}",
        f"width_m = {case.world.width:.6g}",
    ]
    for q in case.measured:
        std = case.errors.stated[q] * misjudged
        text += ["", f"[noise.{COLUMNS[q]}]", f"std = {std:.6g}", 'source = "datasheet"']
    text += ["", "[source]", 'who = "benchmarks.foreign"', 'licence = "CC0-1.0"', 'citation = ""']
    (log / "log.toml").write_text("\n".join(text) + "\n", encoding="utf-8")
