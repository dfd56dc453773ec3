"""Makes a short film of a run on its page: `python -m tests.browser.film DIR PICTURE.webp`.

docs/pictures/live.webp is that of `loadgen run outage --policy default --out DIR`.
"""

import io
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

from offboard.common.live.live_port import LivePort
from offboard.loadgen.play.watch import RunLive
from tests.browser import chromium

SIZE = {"width": 1100, "height": 800}
FRAMES, FRAME_MS, LAST_MS = 40, 200, 2_000
FIRST = 100  # of the 1,000 steps of the slider: before that there is too little to see
QUALITY = 50
SLIDE = """step => {
  const slider = document.getElementById("until");
  slider.value = step;
  slider.dispatchEvent(new Event("input"));
}"""
DRAWN_MS = 250


def film(folder: Path, picture: Path) -> None:
    """Move the slider from the start of the run to its end, and keep what the top of the page shows."""
    path = chromium.find()
    if path is None:
        sys.exit(f"this needs one of {', '.join(chromium.NAMES)}")
    port = LivePort("127.0.0.1:0", "PORT", source=RunLive(folder))
    with sync_playwright() as playwright:
        browser = chromium.launch(playwright, path)
        page = browser.new_page(viewport=SIZE, color_scheme="light")
        page.goto(f"{port.url}/live", wait_until="domcontentloaded")
        page.wait_for_selector("#history .point", state="attached")
        frames = [_frame(page, FIRST + (1000 - FIRST) * n // (FRAMES - 1)) for n in range(FRAMES)]
        browser.close()
    port.close()
    times = [FRAME_MS] * (FRAMES - 1) + [LAST_MS]
    frames[0].save(
        picture, save_all=True, append_images=frames[1:], duration=times, loop=0, quality=QUALITY, method=6
    )


def _frame(page: Page, step: int) -> Image.Image:
    page.evaluate(SLIDE, step)
    page.wait_for_timeout(DRAWN_MS)
    return Image.open(io.BytesIO(page.screenshot())).convert("RGB")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    film(Path(sys.argv[1]), Path(sys.argv[2]))
