"""A headless Chromium for tests, driven through its DevTools protocol; nothing but `websockets` is needed."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path

CHROMIUM = next((p for n in ("chromium", "chromium-browser", "google-chrome") if (p := shutil.which(n))), None)
SCALE = 0.5  # pixels of a screenshot over those of the page


class Page:
    """One page of a browser of its own, 1400 x 1000 pixels, WebGL in software."""

    def __init__(self, url: str, size: tuple[int, int] = (1400, 1000)) -> None:
        from websockets.sync.client import connect

        self._folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        self._process = subprocess.Popen(
            [
                CHROMIUM,
                "--headless=new",
                "--no-sandbox",
                "--disable-gpu-sandbox",
                "--use-angle=swiftshader",
                "--enable-unsafe-swiftshader",
                "--disable-dev-shm-usage",
                "--no-first-run",
                "--mute-audio",
                f"--window-size={size[0]},{size[1]}",
                "--remote-debugging-port=0",
                f"--user-data-dir={self._folder.name}",
                "about:blank",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        port_file, end = Path(self._folder.name, "DevToolsActivePort"), time.monotonic() + 60
        while not (port_file.exists() and "\n" in port_file.read_text()):
            assert time.monotonic() < end and self._process.poll() is None, "the browser did not start"
            time.sleep(0.1)
        port = port_file.read_text().split()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
            target = next(t for t in json.load(answer) if t["type"] == "page")
        self._socket = connect(target["webSocketDebuggerUrl"], max_size=2**26)
        self._count = 0
        self.log: list[str] = []
        self.call("Runtime.enable")
        # half of the pixels each way: WebGL is drawn by the processor
        self.call(
            "Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=SCALE, mobile=False
        )
        self.call("Page.navigate", url=url)

    def call(self, method: str, **params):
        """Return one command of the protocol and its result; errors of the page are kept in `log`."""
        self._count += 1
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": params}))
        while True:
            message = json.loads(self._socket.recv(timeout=90))
            if message.get("method") == "Runtime.exceptionThrown":
                self.log.append(str(message["params"])[:500])
            if message.get("id") == self._count:
                assert "error" not in message, message
                return message["result"]

    def show(self, url: str, width: int, height: int, scale: float = SCALE) -> None:
        """Goes to an address in a window of other sides (pixels of the page), until all of it is there."""
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=scale, mobile=False
        )
        self.js("window.before = true")
        self.call("Page.navigate", url=url)
        self.wait("!window.before && document.readyState === 'complete'")

    def js(self, expression: str):
        """Return the value of a JavaScript expression."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def wait(self, expression: str, seconds: float = 60.0):
        """Wait until the expression is true; returns its value."""
        end = time.monotonic() + seconds
        while not (value := self.js(expression)):
            assert time.monotonic() < end, (
                f"never true: {expression}\n{self.js('document.body.innerText')[:2000]}\n{self.log}"
            )
            time.sleep(0.2)
        return value

    def click(self, text: str) -> None:
        """Click on the middle of the element whose own text (or label) is `text`."""
        at = self.wait(f"""(() => {{ const all = [...document.querySelectorAll('button, label, input, a')];
            const e = all.find(x => x.innerText && x.innerText.trim() === {json.dumps(text)}) ; if (!e) return null;
            const r = e.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]; }})()""")
        self.click_at(*at)

    def click_at(self, x: float, y: float) -> None:
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def press(self, key: str) -> None:
        """Press a key, e.g. ArrowRight."""
        for kind in ("keyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent",
                type=kind,
                key=key,
                code=key,
                windowsVirtualKeyCode={"ArrowRight": 39, "ArrowLeft": 37, "ArrowDown": 40, "Enter": 13}.get(key, 0),
            )

    def screenshot(self, path: Path) -> Path:
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))
        return path

    def close(self) -> None:
        self._socket.close()
        self._process.kill()
        self._process.wait()
        self._folder.cleanup()
