"""Pages as a browser shows them."""

import shutil
import subprocess
from pathlib import Path

import pytest


def in_browser(
    page: Path, profile: Path, what: str, size: str = "1000,900"
) -> subprocess.CompletedProcess[str]:
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("chromium is not installed")
    return subprocess.run(
        [
            *(browser, "--headless", "--no-sandbox", f"--window-size={size}"),
            *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
            *(f"--user-data-dir={profile / 'browser'}", "--virtual-time-budget=20000"),
            *(what, page.as_uri()),
        ],
        capture_output=True,
        text=True,
        timeout=300,
    )
