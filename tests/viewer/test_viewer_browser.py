"""The viewer in a real browser: it connects, draws the cloud, and says nothing on the console."""

import base64
import json
import shutil
import subprocess
import threading
import time
import urllib.request

import cv2
import numpy as np
import pytest

from qs3.viewer.exhibits import ArrayExhibits
from qs3.viewer.pages import gallery_page
from qs3.viewer.serving import serve, url_of

_FLAGS = [
    "--headless",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-sync",
    "--disable-background-networking",
    "--disable-component-update",
    "--remote-debugging-port=0",
    "--window-size=1200,700",
    "about:blank",
]


class Browser:
    """A page of Chromium, driven over its debugging protocol."""

    def __init__(self, profile):
        found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
        if found is None:
            pytest.skip("no chromium here: install it to look at the page in a browser")
        from websockets.sync.client import connect

        flags = [*_FLAGS, f"--user-data-dir={profile}"]
        self.process = subprocess.Popen([found, *flags], stderr=subprocess.PIPE, text=True)
        assert self.process.stderr is not None
        line = next(one for one in self.process.stderr if "DevTools listening" in one)
        port = line.split("ws://")[1].split("/")[0]
        # What is not read would block the browser.
        self.drain = threading.Thread(target=self.process.stderr.read, daemon=True)
        self.drain.start()
        with urllib.request.urlopen(f"http://{port}/json", timeout=30) as answer:
            pages = json.load(answer)
        page = next(one for one in pages if one["type"] == "page")
        self.socket = connect(page["webSocketDebuggerUrl"], max_size=None)
        self.count, self.faults = 0, []
        for domain in ("Runtime", "Log", "Page"):
            self.call(f"{domain}.enable")

    def call(self, method, **given):
        self.count += 1
        self.socket.send(json.dumps({"id": self.count, "method": method, "params": given}))
        while True:
            told = json.loads(self.socket.recv(timeout=60))
            if told.get("id") == self.count:
                return told["result"]
            self._note(told.get("method"), told.get("params"))

    def _note(self, event, told):
        bad = event == "Runtime.exceptionThrown"
        bad |= event == "Runtime.consoleAPICalled" and told["type"] in ("error", "assert")
        bad |= event == "Log.entryAdded" and told["entry"]["level"] == "error"
        if bad:
            self.faults.append(json.dumps(told))

    def picture(self):
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]

    def text(self):
        asked = {"expression": "document.body.innerText", "returnByValue": True}
        return self.call("Runtime.evaluate", **asked)["result"].get("value", "")

    def close(self):
        self.call("Browser.close")
        self.socket.close()
        self.process.wait(30)
        self.drain.join(30)
        self.process.stderr.close()


@pytest.fixture
def browser(tmp_path):
    pytest.importorskip("viser", reason="viser is not installed: pip install 'qs3[view]'")
    browser = Browser(tmp_path / "profile")
    yield browser
    browser.close()


def until(met, seconds=90.0):
    end = time.monotonic() + seconds
    while not met():
        assert time.monotonic() < end, "did not come about"
        time.sleep(0.3)


def test_page_connects_and_draws_without_a_fault(browser, rng):
    """A hostile name stays a name; the violet end of viridis and the yellow one are both drawn."""
    hostile = "<img src=x onerror=\"document.title='run'\">"
    points = rng.uniform(-1, 1, size=(2, 4000, 3)).astype(np.float32)
    items = ArrayExhibits(points, (hostile, "second"), ("bed", hostile))
    with serve(0, "test") as server, gallery_page(server, items) as canvas:
        canvas._mode.value = "height"
        browser.call("Page.navigate", url=url_of(server))
        until(lambda: server.get_clients())

        def drawn():
            seen = browser.picture()[:, :750].reshape(-1, 3).astype(int)
            ends = (np.array([68, 1, 84]), np.array([253, 231, 37]))
            return all((np.abs(seen - end).max(axis=1) < 40).sum() > 100 for end in ends)

        until(drawn)
        until(lambda: hostile in browser.text())
        for handle in server.gui._gui_input_handle_from_uuid.values():
            if handle.label == "Object":
                handle.value = 2
        until(lambda: "second" in browser.text())
        assert browser.call("Runtime.evaluate", expression="document.title")["result"][
            "value"
        ] != "run"  # fmt: skip
    # The page tells that the server has gone: that is no fault of its own.
    assert browser.faults == []
