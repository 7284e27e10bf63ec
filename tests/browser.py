"""A page of Chromium, driven over its debugging protocol."""

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
    """Opens pages, runs scripts in them, and keeps what the console says of faults."""

    def __init__(self, profile):
        path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
        if path is None:
            pytest.skip("no chromium here: install it to look at the page in a browser")
        client = pytest.importorskip("websockets.sync.client", reason="it comes with qs3[view]")
        flags = [*_FLAGS, f"--user-data-dir={profile}"]
        self.process = subprocess.Popen([path, *flags], stderr=subprocess.PIPE, text=True)
        line = next(line for line in self.process.stderr if "DevTools listening" in line)
        port = line.split("ws://")[1].split("/")[0]
        # What is not read would block the browser.
        self.drain = threading.Thread(target=self.process.stderr.read, daemon=True)
        self.drain.start()
        with urllib.request.urlopen(f"http://{port}/json", timeout=30) as answer:
            pages = json.load(answer)
        page = next(page for page in pages if page["type"] == "page")
        self.socket = client.connect(page["webSocketDebuggerUrl"], max_size=None)
        self.count, self.faults = 0, []
        for domain in ("Runtime", "Log", "Page"):
            self.call(f"{domain}.enable")

    def call(self, method, **parameters):
        self.count += 1
        self.socket.send(json.dumps({"id": self.count, "method": method, "params": parameters}))
        while True:
            message = json.loads(self.socket.recv(timeout=60))
            if message.get("id") == self.count:
                return message["result"]
            self._note(message.get("method"), message.get("params"))

    def _note(self, event, message):
        bad = event == "Runtime.exceptionThrown"
        bad |= event == "Runtime.consoleAPICalled" and message["type"] in ("error", "assert")
        bad |= event == "Log.entryAdded" and message["entry"]["level"] == "error"
        if bad:
            self.faults.append(json.dumps(message))

    def open(self, url):
        self.faults.clear()
        self.call("Page.navigate", url=url)
        until(lambda: self.run("document.readyState") == "complete")

    def run(self, script):
        """The value of an expression; of a promise, what it comes to."""
        request = {"expression": script, "returnByValue": True, "awaitPromise": True}
        return self.call("Runtime.evaluate", **request)["result"].get("value")

    def picture(self):
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]

    def close(self):
        self.call("Browser.close")
        self.socket.close()
        self.process.wait(30)
        self.drain.join(30)
        self.process.stderr.close()


def until(met, seconds=90.0):
    end = time.monotonic() + seconds
    while not met():
        assert time.monotonic() < end, "did not come about"
        time.sleep(0.1)
