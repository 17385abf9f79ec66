"""The verb studio: refits that a reader may choose between, and the page that shows them."""

from __future__ import annotations

from pathlib import Path

from lunar_mjx.diagnosis.build_problem import known_logs
from lunar_mjx.diagnosis.folder.refits import REFITS_FILE
from lunar_mjx.diagnosis.report.studio import write_studio
from lunar_mjx.diagnosis.runs import RUN_FILE, SERIES_FILE, VERDICT_FILE, load_run
from lunar_mjx.diagnosis.tables.refits import refit_each
from lunar_mjx.errors import UserError, require_file
from lunar_mjx.inference.fitting import Progress, silent
from lunar_mjx.logs import SteadyLog

MOST_REFITS = 8
"""Effects that are refitted one by one for the page: a second each. The least probable are left as estimates."""


def studio(
    folder: str | Path, out: str | Path | None = None, refit: bool = True, progress: Progress = silent
) -> tuple[Path, str]:
    """Writes the studio of a run: one offline HTML page.

    Args:
      folder: of the run. out: the HTML file; `studio.html` in the run folder if None.
      refit: whether wheel tables are refitted with each of the most probable effects where the run does not hold
        these refits yet. Drives show the refits that `why` kept.
      progress: told of refits.

    Returns:
      The page's path, and a sentence on what was left out of it, or "".

    Raises:
      UserError: the folder is no run, has no comparison, or one of its files is damaged.
    """
    folder, left_out = Path(folder), ""
    require_file(folder / RUN_FILE, "the run (made by `lunar-mjx compare`)")
    if refit and _stale(folder):
        try:
            _refit_tables(folder, progress)
        except UserError as error:
            # a folder that somebody sent comes without its logs, and its page can be read all the same
            left_out = f"studio: nothing was refitted, so errors with an effect are estimates: {error}"
    return write_studio(folder, folder / "studio.html" if out is None else out), left_out


def _stale(folder: Path) -> bool:
    """Whether a diagnosed run holds no refits of its present series."""
    series, refits = folder / SERIES_FILE, folder / REFITS_FILE
    if not series.is_file() or not (folder / VERDICT_FILE).is_file():
        return False
    # Refits of an earlier comparison are of other residuals, even where their number is the same.
    return not refits.is_file() or refits.stat().st_mtime < series.stat().st_mtime


def _refit_tables(folder: Path, progress: Progress) -> None:
    run = load_run(folder)
    logs = known_logs(run)
    verdict = run.load(VERDICT_FILE)
    if not isinstance(logs[0], SteadyLog) or verdict is None:
        return
    seen = [str(e.get("effect")) for e in verdict.get("evidence", []) if e.get("status") != "not tested"]
    # Evidence stands in the order of the verdict: named effects first, then the most probable.
    sets = [[name] for name in seen[:MOST_REFITS]]
    if len(named := [n for n in verdict["effects"] if n in seen]) > 1:
        sets.append(named)
    refit_each(run, [log for log in logs if isinstance(log, SteadyLog)], sets, progress)
