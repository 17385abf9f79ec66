"""The web page of a drive: served on the loopback address, to pages of its own origin only, on one port.

A page from elsewhere must not drive the rover or read what it does. Its browser says where it comes from, in `Origin`
and `Sec-Fetch-Site`; and a foreign name that was made to point here (DNS rebinding) stands in `Host`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import socket
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any
from urllib.parse import parse_qs, urlsplit

import jax
import numpy as np

from lunar_mjx.cameras.scene import Sun
from lunar_mjx.errors import bad_input
from lunar_mjx.viewer.drive import Drive, Pace
from lunar_mjx.viewer.pilot import KEYS
from lunar_mjx.viewer.replay import Replay
from lunar_mjx.viewer.scene import dust_scene, ground_scene, rover_scene

LOOPBACK = "127.0.0.1"


@dataclasses.dataclass(frozen=True)
class ServerLimits:
    """Where the viewer's server listens, and what it bears."""

    port: int = 8600
    dead_man: float = 1.0
    """Held keys are let go when the page has not repeated them for so long, s: it was closed, or hangs."""
    repeat: float = 5.0
    """A page gets the last picture again after so long without a new one, s: so a page that is gone is noticed."""
    longest: int = 4096
    """Bytes of a message from the page."""
    most_connections: int = 64
    """Connections, and threads, at once: a page needs three. Beyond it the idlest one is closed."""


SERVER = ServerLimits()


_SCRIPT = "text/javascript; charset=utf-8"
_FILES = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/style.css": ("style.css", "text/css; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
} | {f"/{name}.js": (f"{name}.js", _SCRIPT) for name in ("main", "maths", "panel", "render", "replay", "shapes")}

_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


def check_port(port: int) -> None:
    """Raises `UserError` for a number that no port has."""
    if not 0 <= port <= 65535:
        raise bad_input("view", "--port", port, "is no port", "give 1024 to 65535, or 0 for any free one")


class Viewer(ThreadingHTTPServer):
    """HTTP server that shows one drive in browsers.

    Args:
      drive: what is shown: a drive that goes on, or one that is over. port: 0 for any that is free.
      sun: the light. clock: s, monotonic.

    Attributes:
      repeat: as in `ServerLimits`; None for never.

    Raises:
      UserError: a port that is no port, or taken.
    """

    daemon_threads = True
    block_on_close = False
    allow_reuse_port = False
    request_queue_size = 1024
    """Connections that wait to be taken: one that finds no place tries again only after a second."""

    def __init__(
        self, drive: Drive, port: int = SERVER.port, sun: Sun | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        check_port(port)
        self.drive = drive
        self.terrain = jax.device_get(drive.model.terrain)
        # Made once: every page that opens asks for it.
        self.scene = json.dumps(rover_scene(drive.model, sun or Sun()) | drive.scene)
        self.pace = Pace(drive, self._show, clock)
        self._fresh = threading.Condition()
        self.repeat: float | None = SERVER.repeat
        self._picture, self._count, self._closed = "", 0, False
        # Nobody holds a key yet.
        self._let_go = math.inf
        self._connections: OrderedDict[Any, bool] = OrderedDict()
        self._counting = threading.Lock()
        self._slots = threading.BoundedSemaphore(SERVER.most_connections)
        try:
            super().__init__((LOOPBACK, port), _Handler)
        except OSError as error:
            raise bad_input(
                "view",
                "--port",
                port,
                f"cannot be opened ({error.strerror})",
                "name another port, or 0 for any free one",
            ) from error
        own = self.server_address[1]
        # On port 80 browsers leave the number out of `Host`.
        self.hosts = {f"{name}:{own}" for name in (LOOPBACK, "localhost")} | (
            {LOOPBACK, "localhost"} if own == 80 else set()
        )
        self.address = f"http://{LOOPBACK}:{own}/"

    def run(self) -> None:
        """Drives and serves until Control-C."""
        try:
            if self.drive.live:
                self.pace.start()
            # Control-C is answered within a tenth of a second.
            self.serve_forever(poll_interval=0.1)
        except KeyboardInterrupt:
            pass
        finally:
            self.close()

    def close(self) -> None:
        """Ends the drive, the connections and the server."""
        self.pace.stop()
        with self._fresh:
            self._closed = True
            self._fresh.notify_all()
        self.server_close()

    def hold(self, keys: list[str]) -> None:
        """Takes the keys that are held down, for `SERVER.dead_man` s."""
        with self.pace.lock:
            self.drive.pilot.hold(keys)
            self._let_go = self.pace.clock() + SERVER.dead_man

    def reset(self) -> None:
        """Puts the rover back to its start."""
        with self.pace.lock:
            self.drive.reset()

    def ground(self, x: float, y: float) -> str:
        """Heights around (x, y) as JSON of the page's scene."""
        return json.dumps(ground_scene(self.terrain, x, y))

    def next_picture(self, after: int) -> tuple[int, str]:
        """The next picture newer than number `after`, or the last one again; an empty one when the drive has ended."""
        with self._fresh:
            self._fresh.wait_for(lambda: self._count > after or self._closed, timeout=self.repeat)
            return self._count, "" if self._closed else self._picture

    def _show(self) -> None:
        with self.pace.lock:
            if self.pace.clock() > self._let_go:
                # A page that was closed must not leave a rover driving.
                self.drive.pilot.hold([])
            readings = self.drive.readings()
            bodies = self.drive.bodies()
            dust = self.drive.dust()
        if self.pace.failure is not None:
            readings["note"] = f"The simulation stopped: {self.pace.failure}"
        # Hundredths of a millimetre: text, sent 25 times a second.
        text = json.dumps({"bodies": np.round(bodies, 5).tolist(), "dust": dust_scene(dust), **_rounded(readings)})
        with self._fresh:
            self._picture, self._count = text, self._count + 1
            self._fresh.notify_all()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Gives a connection its thread; closes the idlest one if there are too many."""
        with self._counting:
            self._connections[request] = False
            if len(self._connections) > SERVER.most_connections:
                # the longest silent one of those that have asked for nothing yet; if all have, of all
                idlest = min(self._connections, key=self._connections.__getitem__)
                del self._connections[idlest]
                with contextlib.suppress(OSError):
                    idlest.shutdown(socket.SHUT_RDWR)  # its thread reads the end and goes
        # Waits until the closed connection's thread has gone, so that threads never outnumber connections.
        self._slots.acquire()
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """What the thread of a connection does."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._slots.release()

    def heard_of(self, request: Any) -> None:
        """Marks a connection as in use."""
        with self._counting:
            if request in self._connections:
                self._connections[request] = True
                self._connections.move_to_end(request)

    def shutdown_request(self, request: Any) -> None:
        """Closes a connection."""
        with self._counting:
            self._connections.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A page that went away is no error."""


class _Handler(BaseHTTPRequestHandler):
    server_version, sys_version = "lunar-mjx", ""
    protocol_version = "HTTP/1.1"
    timeout = 30.0

    @property
    def _viewer(self) -> Viewer:
        assert isinstance(self.server, Viewer)
        return self.server

    def do_GET(self) -> None:
        if not self._welcome():
            return
        url = urlsplit(self.path)
        if url.path in _FILES:
            name, kind = _FILES[url.path]
            self._answer(200, (resources.files("lunar_mjx.viewer") / "page" / name).read_bytes(), kind)
        elif url.path == "/scene":
            self._answer(200, self._viewer.scene.encode(), "application/json")
        elif url.path == "/ground":
            self._ground(url.query)
        elif url.path == "/dust" and isinstance(self._viewer.drive, Replay):
            self._dust(url.query, self._viewer.drive)
        elif url.path == "/pictures":
            self._pictures()
        else:
            self._refuse(404, "there is nothing here")

    def do_POST(self) -> None:
        if not self._welcome():
            return
        # A form on a foreign page cannot send this type without asking first (CORS).
        if self.headers.get("Content-Type", "").split(";")[0] != "application/json":
            self._refuse(415, "send application/json")
            return
        try:
            length = int(self.headers.get("Content-Length", ""))
            # Read no more than a message can hold, whatever the sender says.
            if not 0 < length <= SERVER.longest:
                raise ValueError
            message = json.loads(self.rfile.read(length))
        except (ValueError, RecursionError):
            self._refuse(400, f"send at most {SERVER.longest} bytes of JSON")
            return
        held = message.get("held") if isinstance(message, dict) else None
        if self.path == "/keys" and isinstance(held, list) and all(k in KEYS for k in held):
            self._viewer.hold(held)
        elif self.path == "/reset":
            self._viewer.reset()
        else:
            self._refuse(400, f"send held = some of {', '.join(KEYS)} to /keys, or anything to /reset")
            return
        self._answer(200, b"{}", "application/json")

    def _welcome(self) -> bool:
        """Whether a request comes from this page, this machine's programs or the address bar."""
        self._viewer.heard_of(self.connection)
        host, origin = self.headers.get("Host", ""), self.headers.get("Origin")
        # A foreign name that points here would otherwise make its page ours.
        if host not in self._viewer.hosts:
            self._refuse(403, f"open this page as {self._viewer.address}")
            return False
        if origin is not None and origin not in {f"http://{name}" for name in self._viewer.hosts}:
            self._refuse(403, "pages of another origin may not do this")
            return False
        # A link elsewhere may open the page; it may not act through it.
        typed = self.command == "GET" and self.headers.get("Sec-Fetch-Mode") == "navigate"
        if self.headers.get("Sec-Fetch-Site", "none") not in ("same-origin", "none") and not typed:
            self._refuse(403, "pages of another site may not do this")
            return False
        return True

    def _ground(self, query: str) -> None:
        try:
            asked = parse_qs(query)
            x, y = (float(asked[name][0]) for name in ("x", "y"))
            # float() reads "nan" and "inf".
            if not np.isfinite([x, y]).all():
                raise ValueError
        except (KeyError, ValueError):
            self._refuse(400, "ask as /ground?x=0&y=0")
            return
        self._answer(200, self._viewer.ground(x, y).encode(), "application/json")

    def _dust(self, query: str, drive: Replay) -> None:
        try:
            asked = parse_qs(query)
            time, model = float(asked["time"][0]), int(asked["model"][0])
            if not (math.isfinite(time) and 0 <= model < drive.models):
                raise ValueError
        except (KeyError, ValueError):
            self._refuse(400, "ask as /dust?time=1.5&model=0")
            return
        self._answer(200, json.dumps(dust_scene(drive.thrown(time, model))).encode(), "application/json")

    def _pictures(self) -> None:
        """Server-sent events, one per picture, until the page or the drive ends."""
        self.send_response(200)
        self._common("text/event-stream")
        # A stream has no length: its end is the connection's.
        self.send_header("Connection", "close")
        self.end_headers()
        self.close_connection = True
        count = 0
        try:
            while True:
                count, text = self._viewer.next_picture(count)
                if not text:
                    return
                self.wfile.write(f"data: {text}\n\n".encode())
                self._viewer.heard_of(self.connection)
        except OSError:
            return

    def _answer(self, status: int, body: bytes, kind: str) -> None:
        self.send_response(status)
        self._common(kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def _refuse(self, status: int, why: str) -> None:
        # what was not read would else be taken for the next request
        self.close_connection = True
        self._answer(status, f"lunar-mjx view: {why}\n".encode(), "text/plain; charset=utf-8")

    def _common(self, kind: str) -> None:
        self.send_header("Content-Type", kind)
        for name, value in _HEADERS.items():
            self.send_header(name, value)

    def log_message(self, format: str, *args: Any) -> None:
        """Says nothing: the terminal is the driver's."""


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _rounded(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_rounded(v) for v in value]
    if isinstance(value, float):
        # JSON knows neither infinity nor NaN.
        return round(value, 4) if math.isfinite(value) else None
    return value
