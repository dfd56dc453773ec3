"""Makes a picture of a report: `python -m tests.browser.screenshot REPORT.html PICTURE.png`.

`make figures` makes docs/report.png with it.
"""

import io
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

from tests.browser import chromium

WIDTH = 1280
MARGIN = 12
COLOURS = 256  # so that the file is small


def shoot(report: Path, picture: Path) -> None:
    """Save the top of the page, down to the end of its charts."""
    path = chromium.find()
    if path is None:
        sys.exit(f"this needs one of {', '.join(chromium.NAMES)}")
    with sync_playwright() as playwright:
        browser = chromium.launch(playwright, path)
        page = browser.new_page(viewport={"width": WIDTH, "height": 800}, color_scheme="light")
        page.goto(report.resolve().as_uri())
        box = page.locator("#pictures").bounding_box()
        assert box is not None, "a report has charts"
        clip = {"x": 0, "y": 0, "width": WIDTH, "height": box["y"] + box["height"] + MARGIN}
        png = page.screenshot(full_page=True, clip=clip)
        browser.close()
    Image.open(io.BytesIO(png)).convert("RGB").quantize(COLOURS).save(picture, optimize=True)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    shoot(Path(sys.argv[1]), Path(sys.argv[2]))
