"""Which commit a record tells: git's, or the one that a copy without history was given."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2]))
from benchmarks import provenance


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """A repository of its own, with one file that counts and one that does not."""
    monkeypatch.delenv(provenance.VARIABLE, raising=False)
    monkeypatch.setattr(provenance, "ROOT", tmp_path)
    for name in ("lunar_mjx/code.py", "benchmarks/record.json"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text("1\n")
    for words in (
        ("init", "--quiet"),
        ("add", "."),
        ("-c", "user.name=n", "-c", "user.email=e", "commit", "--quiet", "-m", "First"),
    ):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    return tmp_path


def git(folder, *words):
    return subprocess.run(["git", *words], cwd=folder, capture_output=True, text=True, check=True).stdout.strip()


def test_a_changed_file_counts_and_a_written_record_does_not(repository):
    head = git(repository, "rev-parse", "HEAD")
    (repository / "benchmarks" / "record.json").write_text("2\n")
    assert provenance.checkout() == (head, False) and provenance.commit() == head[:7]
    (repository / "lunar_mjx" / "new.py").write_text("2\n")
    assert provenance.checkout() == (head, True) and provenance.commit() == f"{head[:7]}+"


def test_the_tree_is_the_one_that_git_gives(repository):
    assert provenance.tree() == git(repository, "rev-parse", "HEAD:lunar_mjx")
    (repository / "lunar_mjx" / "code.py").write_text("2\n")
    assert provenance.tree() not in ("", git(repository, "rev-parse", "HEAD:lunar_mjx"))


def test_a_copy_without_history_is_told_its_commit(tmp_path, monkeypatch):
    monkeypatch.setattr(provenance, "ROOT", tmp_path)
    monkeypatch.delenv(provenance.VARIABLE, raising=False)
    assert provenance.checkout() == ("", False) and provenance.commit() == "unknown"
    monkeypatch.setenv(provenance.VARIABLE, "0123456789abcdef+")
    assert provenance.checkout() == ("0123456789abcdef", True) and provenance.commit() == "0123456+"


def test_without_git_nothing_fails(repository, monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert provenance.commit() == "unknown" and provenance.tree() == ""
