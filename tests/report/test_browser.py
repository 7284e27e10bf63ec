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


def probed(page_path: Path, folder: Path, probe: str) -> tuple[str, str]:
    """Run a test's script in the page; what it sets as title comes back, and the console."""
    page = folder / "report.html"
    # The page's policy forbids foreign scripts; without it the same page takes the test's.
    text = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page_path.read_text())
    # A browser that only dumps the document paints few frames: give it a clock of its own.
    clock = "<script>window.requestAnimationFrame = (f) => setTimeout(f, 10);</script></head>"
    text = text.replace("</head>", clock).replace("</body>", f"<script>{probe}</script></body>")
    page.write_text(text)
    document, console = browse(page, folder / "profile")
    title = re.search(r"<title>(.*?)</title>", document, re.DOTALL)
    assert title is not None
    return title[1], console


def test_page_shows_without_a_console_message_and_draws_its_clouds(page_path, tmp_path):
    document, console = browse(page_path, tmp_path / "profile")
    assert console == ""
    assert '<div id="viewer">' in document  # no longer hidden: the policy let the script run
    sizes = re.findall(r'<canvas[^>]* height="(\d+)" width="(\d+)"></canvas>', document)
    assert len(sizes) == 2
    assert all(width == height != "0" for width, height in sizes)


def test_reader_steps_through_the_clouds_of_a_class(page_path, tmp_path):
    """All classes at first; the domain with fewer clouds of a class begins anew."""
    probe = """
      const told = () => [...document.querySelectorAll("#viewer figcaption")].map((f) =>
        f.textContent.replace(/ *Taken.*/s, "").replace(/^target .*: /s, "target: ")).join(" | ")
        + " @ " + document.querySelector("#viewer output").textContent;
      const [back, on] = document.querySelectorAll("#viewer button"), seen = [told()];
      on.click(); seen.push(told());
      back.click(); back.click(); seen.push(told());
      const select = document.querySelector("#viewer select");
      select.value = "0"; select.dispatchEvent(new Event("change")); seen.push(told());
      document.title = seen.join(" ; ");
    """
    title, console = probed(page_path, tmp_path, probe)
    assert console == ""
    assert title.split(" ; ") == [
        "source: bed 1 of 2. | target: bed 1 of 1. @ 1 of 6",
        "source: bed 2 of 2. | target: bed 1 of 1. @ 2 of 6",
        "source: table 2 of 2. | target: table 1 of 1. @ 6 of 6",
        "source: bed 1 of 2. | target: bed 1 of 1. @ 1 of 2",
    ]


@pytest.mark.parametrize("width", [360, 1280])
def test_body_never_scrolls_sideways(page_path, tmp_path, width):
    """In a frame of a phone's width, which a headless window cannot be, and on a desk."""
    outer = tmp_path / "outer.html"
    outer.write_text(
        f'<body style="margin:0"><iframe src="report.html" width="{width}" height="700" '
        'frameborder="0"></iframe></body>'
    )
    (tmp_path / "report.html").write_text(
        page_path.read_text()
        .replace("http-equiv", "data-off")
        .replace(
            "</body>",
            "<script>for (const d of document.querySelectorAll('details')) d.open = true;"
            "parent.postMessage([innerWidth, document.documentElement.scrollWidth -"
            "document.documentElement.clientWidth], '*');"
            "</script></body>",
        )
    )
    outer.write_text(
        "<script>onmessage = (e) => { document.title = e.data.join(' '); };</script>"
        + outer.read_text()
    )
    document, console = browse(outer, tmp_path / "profile")
    assert console == ""
    assert f"<title>{width} 0</title>" in document


def test_clouds_turn_under_the_hand(page_path, tmp_path):
    """A drag changes the picture, and so does an arrow key: told by the canvas's own pixels."""
    probe = """
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
    """
    title, console = probed(page_path, tmp_path, probe)
    assert console == ""
    assert title == "result true true true true"
