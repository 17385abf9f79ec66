"""Puts the criticism report together."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from lunar_mjx._version import __version__
from lunar_mjx.diagnosis.report import explore, figures, tables
from lunar_mjx.diagnosis.report.lead import lead
from lunar_mjx.diagnosis.report.read import Result, read_result, require_whole
from lunar_mjx.diagnosis.report.steps import Step, chain, comparable, error, judged
from lunar_mjx.diagnosis.report.words import and_list, sigmas
from lunar_mjx.diagnosis.verdict import Verdict
from lunar_mjx.errors import UserError
from lunar_mjx.report.page import Block, Figure, Section, Text, write_page


def write_report(runs: Sequence[str | Path], out: str | Path) -> Path:
    """Writes one offline page on a chain of runs.

    Args:
      runs: run folders, in the order in which effects were added.
      out: the HTML file.

    Returns:
      Its path.

    Raises:
      UserError: a folder is no run, or one of its files is damaged, or missing beside what is written with it.
    """
    if not runs:
        raise UserError("report: no run is given; give at least one run folder.")
    results = [read_result(Path(run)) for run in runs]
    for result in results:
        require_whole(result)
    # The last that was diagnosed: a chain may end in a comparison of which nobody has asked why.
    judge = next((r for r in reversed(results) if r.verdict), results[-1])
    steps = chain(results)
    sections = []
    if (judge.verdict or {}).get("verdict") == "BAD_DATA":
        sections.append(Section("Why the logs cannot be used", tables.findings(judge)))
    if steps:
        sections += [_error_section(steps), _where(judge, steps)]
    if judge.verdict:
        sections.append(_why(judge, results))
    sections.append(Section("Parameters", tables.parameters(results[0], results[-1])))
    sections.append(Section("Provenance", tables.provenance(results)))
    # A campaign of thirty drives would make a paragraph of the title.
    logs = list(dict.fromkeys(Path(p).name for p in results[-1].run.get("logs") or []))
    named = logs if len(logs) <= 4 else [*logs[:4], f"{len(logs) - 4} more"]
    title = f"Criticism of a model: {and_list(named)}"
    shown_sections = [s for s in sections if s.blocks]
    return write_page(Path(out), title, _verdict(judge, steps), shown_sections, lead(results, judge))


def _verdict(judge: Result, steps: Sequence[Step]) -> list[str]:
    lines = []
    if judge.verdict:
        lines.append(f"Verdict on {judge.name}, {judge.verdict.get('verdict')}: {judge.verdict.get('sentence')}")
        lines += [str(r["sentence"]) for r in judge.taken_back]
    if len(steps) > 1 and comparable(steps):
        splits, measure = judged(steps)
        first, end = error(steps[0], splits), error(steps[-1], splits)
        if first and end:
            verb = "falls" if end.value < first.value else "rises"
            lines.append(
                f"From {steps[0].label} to {steps[-1].label}, the error on {measure} manoeuvres {verb} from "
                f"{sigmas(first.value)} to {sigmas(end.value)} sigma; the noise is 1."
            )
    lines.append(_audit_line(judge))
    return lines


def _audit_line(result: Result) -> str:
    audit = result.audit or {}
    if audit.get("sentence"):
        older = audit.get("version", __version__) != __version__
        return str(audit["sentence"]) + (f" (Measured with version {audit['version']}.)" if older else "")
    unknown = "How often this tool is wrong on logs like these has not been measured"
    # Logs that were refused, or that no model could be fitted to, have to be mended before anything is measured.
    if (result.verdict or {}).get("verdict") in (Verdict.BAD_DATA.label, Verdict.BAD_FIT.label):
        return f"{unknown}."
    return f"{unknown}; lunar-mjx why {shlex.quote(str(result.path))} --audit 30 measures it in 30 minutes."


def _error_section(steps: Sequence[Step]) -> Section:
    splits, measure = judged(steps)
    errors = [e for s in steps if (e := error(s, splits)) is not None]
    fitted = [error(s, ("fit",)) for s in steps]
    blocks: list[Block] = []
    if not comparable(steps):
        blocks.append(Text(["The runs were not made on the same measurements, so their errors do not compare."]))
    if len(errors) == len(steps):
        caption = (
            f"Root mean square residual over {measure} manoeuvres in sigma of the noise. 1 sigma is the noise floor: a "
            "true model cannot go below it but by chance."
        )
        blocks.append(Figure(figures.waterfall(steps, errors, fitted, measure), caption))
        blocks.append(tables.error_rows(steps, errors, fitted, measure))
    return Section("The error, step by step", blocks)


def _where(judge: Result, steps: Sequence[Step]) -> Section:
    mapped = steps if comparable(steps) else chain([judge])
    blocks: list[Block] = [*explore.panels(mapped), *tables.by_channel(judge), *explore.dependence(judge)]
    verdict = judge.verdict or {}
    ports = verdict.get("ports") or {}
    if ports:
        best = max(ports, key=lambda k: ports[k] or 0.0)
        caption = "Probability that something unlisted acts at a port."
        blocks.append(Figure(figures.bars(ports, "probability, %", best), caption, least=520))
    return Section("Where it fails", blocks)


def _why(judge: Result, results: Sequence[Result]) -> Section:
    blocks = [*tables.hypotheses(judge), *tables.effects(judge)]
    table = (judge.verdict or {}).get("isolability") or {}
    if len(table) > 1:
        caption = (
            "Isolability: |cos| between the signatures that a refit cannot absorb. From 0.9 on, these logs hardly tell "
            "the two effects apart."
        )
        blocks.append(Figure(figures.isolability(table), caption, least=300 + 36 * len(table)))
    # The last run that names something: once that was added, later verdicts may have nothing to show.
    named = next((r for r in reversed(results) if (r.verdict or {}).get("effects")), judge)
    blocks += explore.gallery(named)
    return Section("Why: the evidence for every effect", blocks)
