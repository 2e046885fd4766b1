"""A picture of a part of a report for the documentation, by Chromium through Playwright.

python -m experiments.papers.screenshot runs/demo/report.html --part "#clip-2 .player" -o docs/images/player.webp
"""

import io
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from PIL import Image

from jaxdn.commands.errors import plain_errors


@dataclass
class Settings:
    """Photograph a part of a page."""

    page: Annotated[Path, tyro.conf.Positional]
    """A report."""
    part: str
    """A CSS selector; the clip in it is opened."""
    out: Annotated[Path, tyro.conf.arg(aliases=("-o",))]
    width: int = 1000
    """Of the window in pixels."""


def main(settings: Settings) -> None:
    """Open, wait for the pictures, photograph. Raises ValueError where no Chromium is installed."""
    from playwright.sync_api import sync_playwright

    executable = shutil.which("chromium") or shutil.which("google-chrome")
    if executable is None:
        raise ValueError("chromium: expected it on PATH, found none; install it.")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, args=["--no-sandbox"])
        tab = browser.new_page(viewport={"width": settings.width, "height": 1000})
        tab.goto(settings.page.absolute().as_uri() + settings.part.split()[0])
        part = tab.locator(settings.part)
        part.scroll_into_view_if_needed()
        tab.wait_for_timeout(1000)
        shot = Image.open(io.BytesIO(part.screenshot())).convert("RGB")
        browser.close()
    shot.save(settings.out, quality=88, method=6)
    print(f"{settings.out}: {settings.out.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
