"""Screenshots of reports in a headless Chromium, for the documentation: what `--report` writes, as it looks.

    mitsuba-crb bound scenes/textured_room/textured_room.xml --report room.html
    python benchmarks/report_pictures.py room.html --out docs --layer 1

Writes `room-wide-light.png` and so on, one per width and theme. Needs chromium and chromedriver.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import browser  # noqa: E402  which lives with the tests

SIZES = {"wide": (1280, 900), "narrow": (420, 900)}
SETTLED = 1.0
"""What the last drawing takes after the script is done, on a busy machine [s]."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("pages", nargs="+", type=Path, help="files that --report has written")
    parser.add_argument("--out", type=Path, default=Path(), help="folder of the pictures")
    parser.add_argument("--layer", type=int, default=0, help="which of the page's pictures is shown")
    parser.add_argument("--sizes", nargs="+", default=["wide"], choices=SIZES)
    parser.add_argument("--themes", nargs="+", default=["light", "dark"], choices=["light", "dark"])
    asked = parser.parse_args()
    if browser.programs() is None:
        raise SystemExit("needs chromium and chromedriver: apt-get install chromium chromium-driver")
    with browser.browsing() as window:
        for page in asked.pages:
            for size in asked.sizes:
                for theme in asked.themes:
                    window.size(*SIZES[size])
                    window.scheme(theme)
                    window.open(page)
                    for _ in range(asked.layer):
                        window.run("document.querySelector('.step[data-step=\"1\"]')?.click()")
                    time.sleep(SETTLED)
                    file = asked.out / f"{page.stem}-{size}-{theme}.png"
                    file.write_bytes(window.screenshot(whole=True))
                    print(file, *window.complaints())


if __name__ == "__main__":
    main()
