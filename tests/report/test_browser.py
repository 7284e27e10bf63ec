"""The page in a real browser: no error, and the clouds turn."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

_FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-sync",
    "--disable-background-networking",
    "--disable-component-update",
    "--enable-logging=stderr",
]


def browse(page: Path, profile: Path) -> tuple[str, str]:
    """Return the document after its script ran, and the console."""
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
    if found is None:
        pytest.skip("no chromium here: install it to look at the page in a browser")
    flags = [*_FLAGS, f"--user-data-dir={profile}", "--virtual-time-budget=2000", "--dump-dom"]
    run = subprocess.run(
        [found, *flags, page.as_uri()], capture_output=True, text=True, timeout=120, check=True
    )
    return run.stdout, "\n".join(re.findall(r".*CONSOLE.*", run.stderr))


def test_page_shows_without_a_console_message_and_draws_its_clouds(page_path, tmp_path):
    document, console = browse(page_path, tmp_path / "profile")
    assert console == ""
    assert '<div id="viewer">' in document  # no longer hidden: the policy let the script run
    sizes = re.findall(r' height="(\d+)" width="(\d+)"></canvas>', document)
    assert len(sizes) == 6
    assert all(width == height != "0" for width, height in sizes)


def test_clouds_turn_under_the_hand(page_path, tmp_path):
    """A drag changes the picture, and so does an arrow key: told by the canvas's own pixels."""
    page = tmp_path / "report.html"
    # The page's policy forbids foreign scripts; without it the same page takes the test's.
    text = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page_path.read_text())
    # A browser that only dumps the document paints few frames: give it a clock of its own.
    clock = "<script>window.requestAnimationFrame = (f) => setTimeout(f, 10);</script></head>"
    text = text.replace("</head>", clock)
    probe = """<script>
      const canvas = document.querySelector("canvas"), seen = [];
      const look = () => new Promise((done) => setTimeout(() => {
        seen.push(canvas.toDataURL()); done(); }, 200));
      (async () => {
        await look();
        canvas.dispatchEvent(new PointerEvent("pointermove", { buttons: 1, movementX: 40 }));
        await look();
        canvas.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowUp" }));
        await look();
        canvas.dispatchEvent(new PointerEvent("pointermove", { buttons: 0, movementX: 40 }));
        await look();
        const blank = document.createElement("canvas");
        blank.width = blank.height = canvas.width;
        document.title = ["result", seen[0] !== blank.toDataURL(), seen[0] !== seen[1],
          seen[1] !== seen[2], seen[2] === seen[3]].join(" ");
      })();
    </script></body>"""
    page.write_text(text.replace("</body>", probe))
    document, console = browse(page, tmp_path / "profile")
    assert console == ""
    assert "<title>result true true true true</title>" in document
