"""The pinned packages and their hashes agree."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
HASHED = "requirements-hashed.txt"


def _name(text: str) -> str:
    """A package's name as indices compare it (PEP 503)."""
    return re.sub(r"[-_.]+", "-", text).lower()


def _pins(file: str) -> dict[str, str]:
    lines = (ROOT / file).read_text(encoding="utf-8").splitlines()
    found = (re.match(r"([\w.-]+)==([\w.+]+)", line) for line in lines)
    return {_name(m[1]): m[2] for m in found if m}


def test_every_pin_has_its_hashes_and_no_other_version():
    files = [p.name for p in ROOT.glob("requirements*.txt") if p.name != HASHED]
    assert len(files) == 3
    wanted = {name: version for file in files for name, version in _pins(file).items()}
    assert _pins(HASHED) == wanted, "make hashes"
    text = (ROOT / HASHED).read_text(encoding="utf-8")
    blocks = re.findall(r"^[\w.-]+==[^\n]*((?:\n    --hash=sha256:[0-9a-f]{64}[ \\]*)+)", text, re.MULTILINE)
    assert len(blocks) == len(wanted)
    hashes = [line for line in text.splitlines() if "--hash" in line]
    assert all(re.fullmatch(r" {4}--hash=sha256:[0-9a-f]{64}( \\)?", line) for line in hashes)
