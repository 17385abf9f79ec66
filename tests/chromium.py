"""A headless Chromium, spoken to through its DevTools protocol over pipes: no port is opened, nothing is downloaded."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

CHROMIUM = next((p for n in ("chromium", "chromium-browser", "google-chrome") if (p := shutil.which(n))), None)
ABSENT = "no Chromium on the path; get it by: apt-get install chromium (Debian), brew install --cask chromium (macOS)"
"""Why a test of a page is skipped, and what to do about it."""


_COLLISIONS = """(() => {
  const found = [];
  for (const plot of document.querySelectorAll(".js-plotly-plot")) {
    const words = [...plot.querySelectorAll("svg text")].filter(text => {
      const turned = /rotate\\((-?[0-9.]+)/.exec(text.getAttribute("transform") || "");
      return text.textContent.trim() && !text.closest(".heatmap-label") && !(turned && Number(turned[1]) % 90);
    });
    const boxes = words.map(text => text.getBoundingClientRect());
    boxes.forEach((a, i) => boxes.slice(i + 1).forEach((b, j) => {
      const x = Math.min(a.right, b.right) - Math.max(a.left, b.left);
      const y = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
      if (x > 3 && y > 3) found.push([words[i].textContent, words[i + 1 + j].textContent]);
    }));
  }
  return found;
})()"""


class Browser:
    """One page of a headless Chromium with software WebGL.

    Attributes:
      problems: errors of the page and entries of its log. requests: addresses that it asked for.
      most_frames: how often the page is drawn while `wait` looks: what never comes is told instead of waited for. It is
        drawn 60 times a second where it is idle, and less often where it is busy.
    """

    most_frames = 36_000

    def __init__(self, folder: Path, size: tuple[int, int] = (1280, 760)):
        assert CHROMIUM is not None
        to_read, self._write = os.pipe()
        self._read, to_write = os.pipe()
        flags = [
            "--headless=new",
            "--no-sandbox",
            "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader",
            "--disable-dev-shm-usage",
            "--no-first-run",
            "--disable-background-networking",
            "--hide-scrollbars",
            "--remote-debugging-pipe",
            f"--user-data-dir={folder}",
        ]
        # DevTools speaks on the file descriptors 3 and 4
        shell = f"exec '{CHROMIUM}' \"$@\" 3<&{to_read} 4>&{to_write}"
        self._process = subprocess.Popen(
            ["bash", "-c", shell, "chromium", *flags, "about:blank"],
            pass_fds=(to_read, to_write),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_read)
        os.close(to_write)
        self._count, self._rest, self.problems = 0, b"", []
        self.requests: list[str] = []
        self._session: str | None = None
        targets = self.call("Target.getTargets")["targetInfos"]
        page = next(t["targetId"] for t in targets if t["type"] == "page")
        self._session = self.call("Target.attachToTarget", targetId=page, flatten=True)["sessionId"]
        self.call("Page.enable")
        self.call("Runtime.enable")
        self.call("Log.enable")
        self.call("Network.enable")
        self.call(
            "Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1, mobile=False
        )

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Calls a method of the protocol and returns its result."""
        self._count += 1
        message = {"id": self._count, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded"):
                self.problems.append(answer["params"])
            if answer.get("method") == "Network.requestWillBeSent":
                self.requests.append(answer["params"]["request"]["url"])
            if answer.get("id") == self._count:
                assert "error" not in answer, answer["error"]
                return answer["result"]

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            piece = os.read(self._read, 1 << 16)
            assert piece, "Chromium ended"
            self._rest += piece
        text, _, self._rest = self._rest.partition(b"\0")
        return json.loads(text)

    def open(self, address: str) -> None:
        self.call("Page.navigate", url=address)

    def value(self, expression: str) -> Any:
        """Value of a JavaScript expression on the page; promises are awaited."""
        result = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def wait(self, expression: str) -> Any:
        """Waits until an expression is true; the page looks each time that it is drawn.

        Raises:
          TimeoutError: it was drawn `most_frames` times, and the expression was never true.
        """
        look = (
            f"let left = {self.most_frames}; const look = () => {{ const v = {expression}; "
            "v || !left-- ? done(v || null) : requestAnimationFrame(look); }; look();"
        )
        found = self.value(f"new Promise(done => {{ {look} }})")
        if found is None:
            raise TimeoutError(f"not within {self.most_frames} frames of the page: {expression}")
        return found

    def key(self, kind: str, code: str, key: str) -> None:
        """`kind` is keyDown or keyUp."""
        self.call("Input.dispatchKeyEvent", type=kind, code=code, key=key)

    def press(self, key: str) -> None:
        """Presses and releases a key that moves the focus or the choice, such as Tab, Enter or ArrowDown."""
        number = {"Tab": 9, "Enter": 13, "End": 35, "Home": 36}
        number |= {f"Arrow{way}": 37 + i for i, way in enumerate(("Left", "Up", "Right", "Down"))}
        text = {"text": "\r"} if key == "Enter" else {}
        for kind in ("keyDown", "keyUp"):
            more = text if kind == "keyDown" else {}
            self.call("Input.dispatchKeyEvent", type=kind, code=key, key=key, windowsVirtualKeyCode=number[key], **more)

    def click(self, x: float, y: float) -> None:
        """Moves the mouse to a place of the window and clicks there."""
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def dark(self, on: bool = True) -> None:
        """Prefers dark pages; a page reads it when it is opened."""
        value = "dark" if on else "light"
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": value}])

    def asked(self) -> list[str]:
        """Addresses that the page asked for and that it did not itself hold."""
        return [address for address in self.requests if not address.startswith(("data:", "blob:"))]

    def collisions(self) -> list[list[str]]:
        """Pairs of words of a figure that lie on each other; numbers within coloured fields are left out."""
        return self.value(_COLLISIONS)

    def resize(self, width: int, height: int) -> None:
        """Gives the page another size, of a phone below 600 pixels."""
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600
        )

    def picture(self, path: Path) -> Path:
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))
        return path

    def close(self) -> None:
        os.close(self._write)  # Chromium ends when its pipe does
        self._process.wait()
        os.close(self._read)
