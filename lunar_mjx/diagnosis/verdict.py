"""The answer of a diagnosis: one of eight verdicts, which is also the exit status of `why` and `improve`."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Mapping
from typing import Any


class Verdict(enum.Enum):
    """What the logs say about the model; `exit_status` is the exit status of the command."""

    # Tens for scripts: 1x, nothing is said about physics; 2x, something is named; 3x, nothing can be named.
    NOISE_ONLY = ("NOISE_ONLY", 0)
    """Nothing is missing beyond usual errors of model, sensors and noise."""
    BAD_DATA = ("BAD_DATA", 10)
    """The log itself cannot be used; nothing is said about physics."""
    BAD_FIT = ("BAD_FIT", 11)
    """The solver failed; nothing is said about physics."""
    KNOWN = ("KNOWN", 20)
    """One catalogue effect is missing, whatever discrepancy remains."""
    KNOWN_CLASS = ("KNOWN_CLASS", 21)
    """One of several effects that these logs cannot tell apart; where one is named, that or something unlisted."""
    MULTIPLE = ("MULTIPLE", 22)
    """Several effects are missing, each of them surely."""
    UNKNOWN = ("UNKNOWN", 30)
    """Something is missing at a port that no catalogue effect explains."""
    UNDECIDABLE = ("UNDECIDABLE", 31)
    """No statement has 95 per cent, or the effect asked about leaves no separable signal in these logs."""

    def __init__(self, label: str, exit_status: int):
        self.label = label
        self.exit_status = exit_status


@dataclasses.dataclass(frozen=True)
class EffectEvidence:
    """What the logs say for and against one effect.

    Attributes:
      effect: its name.
      separable_sigma: length of the effect's signature at its nominal size, after refitting of the baseline has been
        projected out, in sigma; below 5 the effect is not tested.
      z: root of twice the log ratio of the most probable hypothesis with it to the most probable one without, with the
        ratio's sign, in sigma.
      values: fitted parameters by name; std: their standard deviations.
      probability: that the effect is missing, whatever else is; NaN where hypotheses were not weighed, and where the
        search ended before a refit with it was made.
      nearest: the effect with the most similar projected signature, and |cos| between the two.
      status: "accepted", "rejected", "confounded", "not refitted", "not tested" or "not significant".
      reason: in a few words.
    """

    effect: str
    separable_sigma: float
    z: float = 0.0
    values: Mapping[str, float] = dataclasses.field(default_factory=dict)
    std: Mapping[str, float] = dataclasses.field(default_factory=dict)
    nearest: tuple[str, float] = ("", 0.0)
    probability: float = float("nan")
    status: str = "not significant"
    reason: str = ""


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """Verdict and evidence; plain data that `to_dict` makes ready for JSON.

    Attributes:
      verdict: the answer.
      effects: the effects named by it, strongest first; for UNKNOWN those that help without sufficing.
      port: where something unknown acts, for UNKNOWN.
      sentence: the verdict in one sentence.
      evidence: of every effect, strongest first.
      ports: evidence by port: gain of log evidence of an unknown input there.
      error_before, error_after: root mean square residual in sigma on fitted and on held-out manoeuvres, before and
        with the effects named.
      isolability: |cos| between projected signatures, by pairs of effects.
      undecidable: effects that leave no separable signal in these logs.
      probability: of the verdict as a statement; 0 for UNDECIDABLE, which states nothing. probabilities: by hypothesis,
        together 1. inclusion: by effect, that it is missing whatever else is, without those that no refit has held.
        forms: by form of the model, such as its contact law.
      unlisted: whether something unlisted at `port` belongs to the statement.
      further: beside `effects`, one of these (or something unlisted, where `unlisted`) acts, too.
      discrepancy: what remains, by port: `size` (share of the force or stress there), its 68 % range `low` to `high`,
        and `text` in the user's terms.
      details: certificate of the fit, seeds, splits and whatever else a report shows.
    """

    verdict: Verdict
    effects: tuple[str, ...]
    sentence: str
    evidence: tuple[EffectEvidence, ...] = ()
    port: str | None = None
    ports: Mapping[str, float] = dataclasses.field(default_factory=dict)
    error_before: Mapping[str, float] = dataclasses.field(default_factory=dict)
    error_after: Mapping[str, float] = dataclasses.field(default_factory=dict)
    isolability: Mapping[str, Mapping[str, float]] = dataclasses.field(default_factory=dict)
    undecidable: tuple[str, ...] = ()
    probability: float = float("nan")
    probabilities: Mapping[str, float] = dataclasses.field(default_factory=dict)
    inclusion: Mapping[str, float] = dataclasses.field(default_factory=dict)
    forms: Mapping[str, float] = dataclasses.field(default_factory=dict)
    unlisted: bool = False
    further: tuple[str, ...] = ()
    discrepancy: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    details: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Numbers, names and lists only."""
        plain = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        plain["verdict"] = self.verdict.label
        plain["exit_status"] = self.verdict.exit_status
        plain["effects"] = list(self.effects)
        plain["further"] = list(self.further)
        plain["evidence"] = [dataclasses.asdict(e) for e in self.evidence]
        return plain
