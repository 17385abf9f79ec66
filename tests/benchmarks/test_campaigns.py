"""A sweep over foreign drives keeps what it has, and begins nothing that cannot end."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.foreign.drives import campaigns, cases

JOB = ("tune", 5, 1, "null", (), "husky")


def test_groups_and_rovers_alternate() -> None:
    jobs = campaigns.jobs("report", 1, 24)
    assert len(jobs) == 24 and len({j[2] for j in jobs}) == 24
    for part in (jobs[:12], jobs[12:]):
        assert {j[3] for j in part} == {"null", "single", "outside"}
        assert {j[5] for j in part} == {"luvmi_x", "viper", "husky"}


def test_a_campaign_is_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = []
    monkeypatch.setattr(
        campaigns, "make_told", lambda case: made.append(case) or ({"position": np.zeros((5, 1, 3))}, {})
    )
    monkeypatch.setattr(cases, "write", lambda case, found, folder: folder.mkdir(parents=True))
    campaigns.make(JOB, tmp_path)
    campaigns.make(JOB, tmp_path)
    assert len(made) == 1
    truth = json.loads((tmp_path / "truth" / "tune-drive-001.json").read_text())
    assert truth["rover"] == "husky" and truth["hidden"] == [] and truth["separable"] == {}


def test_nothing_is_begun_for_which_there_is_no_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ends = []
    monkeypatch.setattr(campaigns, "ask", lambda job, folder, until, settings: ends.append(until - now))
    now = 1000.0
    monkeypatch.setattr(campaigns.time, "monotonic", lambda: now)
    for left, limit in ((300.0, 0.0), (500.0, 0.0), (5000.0, 400.0)):
        for name, value in (("folder", tmp_path), ("until", now + left), ("limit_s", limit)):
            monkeypatch.setattr(campaigns._Process, name, value)
        campaigns._ask(JOB)
    assert ends == [pytest.approx(485.0), pytest.approx(400.0)]


@pytest.mark.parametrize("rover", ["luvmi_x", "viper", "husky"])
def test_a_chassis_as_built_is_a_body(rover: str) -> None:
    """Each principal inertia is at most the sum of the other two, and within 15 % of the description's."""
    nominal = np.array(cases.ROVERS[rover].chassis_inertia)
    for number in range(40):
        case = cases.draw("report", 7, number, "null", (), rover)
        factors = np.array(case.setups[0].build.inertia)
        assert np.all(np.abs(factors - 1.0) <= 0.15 + 1e-12)
        assert np.all(2.0 * factors * nominal <= np.sum(factors * nominal) + 1e-12)


def test_processes_share_the_cores() -> None:
    assert campaigns.core_shares(range(2, 8), 3) == [{2, 3}, {4, 5}, {6, 7}]
    assert campaigns.core_shares([0, 1], 3) == [{0}, {1}, {0}]


def test_processes_take_gpus_in_turn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import queue

    monkeypatch.setattr(campaigns.os, "sched_setaffinity", lambda *_: None)
    monkeypatch.setattr(campaigns.os, "environ", {})
    for name in ("folder", "until", "limit_s", "settings"):
        monkeypatch.setattr(campaigns._Process, name, getattr(campaigns._Process, name))
    places: queue.Queue = queue.Queue()
    for place in campaigns.places([{0}, {1}, {2}], 2):
        places.put(place)
    seen = []
    for _ in range(6):  # a process died, and all three were started anew
        assert not places.empty()
        campaigns._begin(places, tmp_path, 0.0, 0.0, {})
        seen.append(campaigns.os.environ["CUDA_VISIBLE_DEVICES"])
    assert seen == ["0", "1", "0"] * 2


def test_gpus_are_the_first_of_those_that_are_visible() -> None:
    shares = [{0}, {1}, {2}]
    assert [gpu for _, gpu in campaigns.places(shares, 2, "5,GPU-8f0c,7")] == ["5", "GPU-8f0c", "5"]
    for visible, count in (("5", 1), ("", 0)):
        with pytest.raises(SystemExit, match=f"--gpus 2: CUDA_VISIBLE_DEVICES={visible} lists {count};"):
            campaigns.places(shares, 2, visible)


def test_without_gpus_jax_computes_on_cores_alone() -> None:
    """A process that has begun imports JAX only then, so that JAX heeds it."""
    program = """
import os, pathlib, queue
from benchmarks.foreign.drives import campaigns
places = queue.Queue()
for place in campaigns.places([os.sched_getaffinity(0)], 0, "0,1"):
    places.put(place)
campaigns._begin(places, pathlib.Path("."), 0.0, 0.0, {})
import jax
print(jax.config.jax_platforms)
"""
    chosen = {k: v for k, v in os.environ.items() if k != "JAX_PLATFORMS"}
    told = subprocess.run([sys.executable, "-c", program], env=chosen, capture_output=True, text=True, check=True)
    assert told.stdout.split() == ["cpu"]
