"""What asks a drive that is served, as the page does or as others try to."""

from __future__ import annotations

import http.client
import json
from collections.abc import Iterator
from typing import Any

from lunar_mjx.viewer.server import Viewer


class Clock:
    """A clock that stands still until it is moved."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def ask(viewer: Viewer, method: str, path: str, body: Any = None, **headers: str) -> tuple[int, dict[str, str], bytes]:
    """Status, headers and body of an answer; underscores in the names of `headers` are hyphens."""
    connection = http.client.HTTPConnection("127.0.0.1", viewer.server_address[1])
    sent = {k.replace("_", "-"): v for k, v in headers.items()}
    text = None
    if body is not None:
        text = body if isinstance(body, str) else json.dumps(body)
        sent.setdefault("Content-Type", "application/json")
    connection.request(method, path, text, sent)
    answer = connection.getresponse()
    try:
        return answer.status, dict(answer.getheaders()), answer.read()
    finally:
        connection.close()


def pictures(viewer: Viewer) -> Iterator[dict[str, Any]]:
    """The drive's pictures as the page gets them."""
    connection = http.client.HTTPConnection("127.0.0.1", viewer.server_address[1])
    connection.request("GET", "/pictures")
    answer = connection.getresponse()
    try:
        while line := answer.readline():
            if line.startswith(b"data: "):
                yield json.loads(line.removeprefix(b"data: "))
    finally:
        connection.close()
