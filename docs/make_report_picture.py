"""Photograph the report of a demo, on a desk and on a phone, with a headless Chromium.

Usage: ``qs3 demo --out demo && python docs/make_report_picture.py demo/report.html``
"""

import argparse
import shutil
import subprocess
import tempfile
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

_FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--hide-scrollbars")


def photograph(page: Path, width: int, height: int, top: int = 0) -> UInt8[np.ndarray, "h w 3"]:
    """Picture of a page as a screen of that size shows it, BGR.

    Args:
        page: An HTML file.
        width: Of the screen in pixels; a frame makes one narrower than a window can be.
        height: Of the screen in pixels.
        top: Rows that the reader has scrolled by.
    """
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        raise SystemExit("no chromium here: install it to take the picture")
    with tempfile.TemporaryDirectory() as folder:
        frame, shot = Path(folder, "frame.html"), Path(folder, "shot.png")
        frame.write_text(
            f'<body style="margin:0;overflow:hidden"><iframe src="{page.resolve().as_uri()}" '
            f'width="{width}" height="{height + top}" frameborder="0" scrolling="no" '
            f'style="margin-top:-{top}px"></iframe></body>',
            encoding="utf-8",
        )
        size = f"--window-size={max(width, 600)},{height}"
        profile = f"--user-data-dir={folder}/profile"
        subprocess.run(
            [browser, *_FLAGS, size, profile, "--virtual-time-budget=3000",
             f"--screenshot={shot}", frame.as_uri()],
            check=True,
            capture_output=True,
        )  # fmt: skip
        picture = cv2.imread(str(shot))
    assert picture is not None  # noqa: S101
    return picture[:height, :width]


def main() -> None:
    """Write the picture that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("page", type=Path)
    parser.add_argument("--tops", type=int, nargs=3, default=(0, 2650, 3560))
    parser.add_argument("--height", type=int, default=1000)
    here = Path(__file__).parent / "images" / "report.png"
    parser.add_argument("--out", type=Path, default=here)
    args = parser.parse_args()
    first, second, phone = args.tops
    shots = [
        photograph(args.page, 960, args.height, first),
        photograph(args.page, 960, args.height, second),
        photograph(args.page, 360, args.height, phone),
    ]
    gap = np.full((args.height, 24, 3), 120, np.uint8)
    parts = [part for shot in shots for part in (gap, shot)][1:]
    small = cv2.resize(np.hstack(parts), None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(args.out), small, [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
