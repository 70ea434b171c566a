"""A headless Chromium from the distribution's packages, which draws WebGL in software."""

from __future__ import annotations

import base64
import io
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image

PROGRAMS = 'chromium', 'chromedriver'
FLAGS = (
    *('--headless', '--no-sandbox', '--disable-gpu', '--disable-quic', '--no-first-run', '--disable-sync'),
    *('--disable-background-networking', '--disable-component-update', '--disable-dev-shm-usage'),
    *('--use-gl=angle', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--window-size=1300,1000'),
)
PATIENCE = 60.0  # seconds


def missing() -> list[str]:
    """Return the programs that are not installed."""
    return [name for name in PROGRAMS if not shutil.which(name)]


@contextmanager
def chromium() -> Iterator:
    """Start a browser with a profile of its own, and end it."""
    from selenium import webdriver

    browser, driver = (shutil.which(name) for name in PROGRAMS)
    options = webdriver.ChromeOptions()
    options.binary_location = browser
    options.set_capability('goog:loggingPrefs', {'browser': 'ALL'})
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        for flag in (*FLAGS, f'--user-data-dir={folder}'):
            options.add_argument(flag)
        running = webdriver.Chrome(options, webdriver.ChromeService(driver))
        try:
            yield running
        finally:
            running.quit()


def opened(browser, path: str | Path) -> np.ndarray:
    """Load a report and return its 3-D view once that is there; see :func:`settled`."""
    browser.get(f'file://{path}')
    end = time.monotonic() + PATIENCE
    while not browser.execute_script('return Boolean(window.csgm)'):
        if time.monotonic() > end:
            raise TimeoutError(f'{path}: {browser.get_log("browser")}')
        time.sleep(0.1)
    failed = browser.execute_script('return csgm.failed || null')
    if failed:
        raise RuntimeError(f'{path}: {failed}')
    return settled(browser)


def settled(browser) -> np.ndarray:
    """Wait until nothing moves; return the (H, W, 3) int pixels of the 3-D view."""
    end = time.monotonic() + PATIENCE
    while browser.execute_script('return csgm.view.running'):
        if time.monotonic() > end:
            raise TimeoutError('the view does not come to rest')
        time.sleep(0.1)
    text = browser.execute_script('return document.getElementById("view").toDataURL("image/png")')
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(text.split(',')[1]))).convert('RGB')).astype(int)
