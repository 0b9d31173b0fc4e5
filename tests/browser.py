"""A headless Chromium, led over its DevTools pipe: what a page logs, asks for and looks like.

python tests/browser.py out/report.html shots/    pictures of a page, light and dark, desktop and phone
"""

from __future__ import annotations

import base64
import contextlib
import fcntl
import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome")
DESKTOP, PHONE = (1400, 900), (390, 844)
PLOTS = "[...document.querySelectorAll('.plot')].filter(p => !p.closest('details'))"
DRAWN = ".js-plotly-plot"
_PATIENCE = 60.0  # s


def find() -> str | None:
    """The browser's program, if there is one."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Browser:
    """One tab. `trouble` is everything logged as an error or thrown, `asked` every address asked for."""

    density = 1  # pixels per CSS pixel; drawn by software, a page of twice as many takes four times as long to paint

    def __init__(self, program: str, profile: str) -> None:
        # the browser reads from 3 and writes to 4: keep our own ends away from those numbers
        ours_in, theirs_out = (fcntl.fcntl(fd, fcntl.F_DUPFD, 10) for fd in os.pipe())
        theirs_in, ours_out = (fcntl.fcntl(fd, fcntl.F_DUPFD, 10) for fd in os.pipe())

        def placed() -> None:
            os.dup2(theirs_in, 3)
            os.dup2(theirs_out, 4)

        flags = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--remote-debugging-pipe"]
        flags += ["--no-first-run", "--disable-background-networking", "--disable-component-update"]
        # no name is found, so nothing can come from the network
        flags += ["--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={profile}", "about:blank"]
        self.process = subprocess.Popen(
            [program, *flags], pass_fds=(3, 4), preexec_fn=placed, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        for fd in (theirs_in, theirs_out):
            os.close(fd)
        self._in, self._out, self._rest, self._id = ours_in, ours_out, b"", 0
        self.trouble: list[str] = []
        self.asked: list[str] = []
        self._session: str | None = None
        tabs = self._call("Target.getTargets")["targetInfos"]
        target = next(tab["targetId"] for tab in tabs if tab["type"] == "page")
        self._session = self._call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self._call(f"{domain}.enable")

    def open(self, path: Path, size: tuple[int, int] = DESKTOP, dark: bool = False, scripts: bool = True) -> None:
        """Go to a file, in a window of this size, as a reader with light or dark taste."""
        width, height = size
        phone = width < 600
        self._call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=self.density,
            mobile=phone,
        )
        self._call("Emulation.setTouchEmulationEnabled", enabled=phone)
        self._call("Emulation.setScriptExecutionDisabled", value=not scripts)
        self.colours(dark)
        self.trouble.clear()
        self.asked.clear()
        self._call("Page.navigate", url=path.resolve().as_uri())
        self.wait("document.readyState === 'complete'")

    def colours(self, dark: bool) -> None:
        """Change the reader's taste."""
        feature = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self._call("Emulation.setEmulatedMedia", features=[feature])

    def mouse(self, what: str, x: float, y: float, pressed: bool = False) -> None:
        """mouseMoved, mousePressed or mouseReleased."""
        left = "left" if pressed or what != "mouseMoved" else "none"
        buttons = int(pressed or what == "mousePressed")
        self._call("Input.dispatchMouseEvent", type=what, x=x, y=y, button=left, buttons=buttons, clickCount=1)

    def run(self, expression: str) -> Any:
        """The value of an expression, waited for if it is a promise."""
        answer = self._call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def wait(self, expression: str) -> None:
        """Until the expression is true."""
        end = time.monotonic() + _PATIENCE
        while not self.run(expression):
            assert time.monotonic() < end, f"never true: {expression}"
            time.sleep(0.05)

    def read(self, pictures: str = PLOTS, drawn: str = DRAWN) -> None:
        """Scroll to one picture after the other until it is drawn, `drawn` of it, as they wait to be seen.

        None is passed before it is: a busy machine draws few frames, and what is passed between two is never seen.
        """
        for k in range(self.run(f"[...{pictures}].length")):
            self.run(f"[...{pictures}][{k}].scrollIntoView({{block: 'center', behavior: 'instant'}})")
            self.wait(f"[...{pictures}][{k}].matches('{drawn}')")
        self.run("scrollTo(0, 0)")

    def shot(self, path: Path) -> None:
        """A picture of the whole page."""
        size = self._call("Page.getLayoutMetrics")["cssContentSize"]
        clip = {"x": 0, "y": 0, "width": size["width"], "height": size["height"], "scale": 0.5}
        image = self._call("Page.captureScreenshot", captureBeyondViewport=True, clip=clip)
        path.write_bytes(base64.b64decode(image["data"]))

    def close(self) -> None:
        """End the browser."""
        with contextlib.suppress(OSError, AssertionError):
            self._session = None
            self._call("Browser.close")
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        os.close(self._in)
        os.close(self._out)

    def _call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._id += 1
        message: dict[str, Any] = {"id": self._id, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self._id:
                assert "error" not in answer, answer["error"]
                return answer["result"]
            self._heard(answer)

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._in], [], [], _PATIENCE)
            assert ready, "the browser does not answer"
            part = os.read(self._in, 1 << 20)
            assert part, "the browser has gone"
            self._rest += part
        message, self._rest = self._rest.split(b"\0", 1)
        return json.loads(message)

    def _heard(self, event: dict[str, Any]) -> None:
        method, said = event.get("method"), event.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.trouble.append(json.dumps(said["exceptionDetails"]))
        elif method == "Runtime.consoleAPICalled" and said["type"] in ("error", "warning", "assert"):
            self.trouble.append(json.dumps(said["args"]))
        elif method == "Log.entryAdded" and said["entry"]["level"] in ("error", "warning"):
            self.trouble.append(said["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.asked.append(said["request"]["url"])


@contextlib.contextmanager
def browser() -> Iterator[Browser]:
    """A browser of one's own, for a while."""
    program = find()
    assert program is not None
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        one = Browser(program, profile)
        try:
            yield one
        finally:
            one.close()


def main() -> None:
    page, folder = Path(sys.argv[1]), Path(sys.argv[2])
    folder.mkdir(parents=True, exist_ok=True)
    with browser() as one:
        one.density = 2
        for device, size in (("desktop", DESKTOP), ("phone", PHONE)):
            for dark in (False, True):
                one.open(page, size, dark)
                one.wait("document.documentElement.dataset.ready !== undefined")
                one.read()
                time.sleep(0.5)
                one.shot(folder / f"{page.stem}-{device}-{'dark' if dark else 'light'}.png")
                wide = one.run("document.documentElement.scrollWidth")
                print(f"{device} {'dark' if dark else 'light'}: {wide} px wide, trouble: {one.trouble or 'none'}")


if __name__ == "__main__":
    main()
