"""A headless Chromium for tests of pages: opened on a page, it fails the test for any error on the page's console."""

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
FLAGS = [
    *("--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *(
        "--use-gl=angle",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
    ),  # WebGL without a graphics card
]
WAIT_MS = 120_000


@contextlib.contextmanager
def chromium() -> Iterator:
    """Give a browser of playwright's; the test is skipped where no Chromium is installed."""
    if CHROMIUM is None:
        pytest.skip("no chromium is installed to open the page in: apt-get install chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        try:
            yield browser
        finally:
            browser.close()


@contextlib.contextmanager
def opened(
    browser, url: str, width: int = 900, height: int = 700, before: str = "", known: tuple[str, ...] = ()
) -> Iterator:
    """Give a page that does not move by itself; at the end the test fails if the page's console had an error.

    Args:
        before: a program that the page runs before its own.
        known: parts of errors of a library's that are let pass.
    """
    page = browser.new_page(viewport={"width": width, "height": height}, reduced_motion="reduce")
    page.set_default_timeout(WAIT_MS)
    errors: list[str] = []
    page.on("console", lambda m: errors.append(m.text) if m.type == "error" else None)
    page.on("pageerror", lambda e: errors.append(str(e)))
    page.add_init_script(before)
    page.goto(url)
    yield page
    page.close()
    assert [error for error in errors if not any(part in error for part in known)] == []


def pixels(page, canvas: str) -> np.ndarray:
    """Return what a canvas shows, found by its CSS selector, as bytes [H, W, 3]."""
    import base64

    import imagecodecs

    source = page.eval_on_selector(canvas, "canvas => canvas.toDataURL('image/png')")
    return np.asarray(imagecodecs.png_decode(base64.b64decode(source.partition(",")[2])))[..., :3]


def as_url(path: Path) -> str:
    return path.resolve().as_uri()
