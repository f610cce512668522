"""Film the console during the paper's mission, as an animated WebP for README.md: one minute.

The script flies a session in real time and takes screenshots in a headless Chromium.
"""

from __future__ import annotations

import io
import shutil
import subprocess
import sys
import time
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

ROOT = Path(__file__).resolve().parents[1]
TARGET, SESSION = ROOT / "docs" / "console.webp", ROOT / "build" / "console"
COUNT, PERIOD, SHOWN, LAST = 46, 0.75, 0.15, 1.5
"""Number of screenshots; time between them, time for which each is shown, and the last one [s]."""
SIZE, QUALITY = (960, 600), 45
FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def film(page: Page) -> list[Image.Image]:
    """Fly the mission and return the screenshots."""
    button = page.get_by_role("button", name="Start", exact=True)
    button.wait_for(timeout=120e3)
    time.sleep(5.0)  # the scene appears after the buttons
    for note in page.locator(".mantine-Notification-closeButton").all():
        note.click()  # "software rendering"
    button.click()
    frames, due = [], time.monotonic()
    for _ in range(COUNT):
        picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
        frames.append(picture.resize(SIZE, Image.Resampling.LANCZOS))
        due += PERIOD
        time.sleep(max(0.0, due - time.monotonic()))
    return frames


def main() -> None:
    """Fly, film and write the picture."""
    shutil.rmtree(SESSION, ignore_errors=True)
    command = [sys.executable, "-m", "cloudrc", "up", "--console", "--out", str(SESSION)]
    session = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert session.stdout is not None
        line = next(line for line in session.stdout if line.startswith("console: "))
        with sync_playwright() as started:
            browser = started.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
            page = browser.new_page(viewport={"width": 1280, "height": 800})
            page.goto(line.split()[-1])
            frames = film(page)
            browser.close()
    finally:
        session.terminate()
        session.communicate()
    times = [round(SHOWN * 1e3)] * (len(frames) - 1) + [round(LAST * 1e3)]
    about = {"save_all": True, "append_images": frames[1:], "duration": times, "loop": 0}
    frames[0].save(TARGET, quality=QUALITY, method=6, minimize_size=True, **about)
    print(f"{TARGET}: {len(frames)} pictures, {TARGET.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
