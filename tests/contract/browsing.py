"""A browser for the tests of the pages, once a module; without one they are skipped."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="needs the extra [page]")
playwright = pytest.importorskip("playwright.sync_api", reason="needs the extra [dev]")

CHROMIUM = Path("/usr/bin/chromium")
WAIT_MS = 60_000
IN_A_BROWSER = [
    pytest.mark.skipif(not CHROMIUM.exists(), reason=f"needs a browser at {CHROMIUM}"),
    pytest.mark.real_time(reason="a browser shows and sends in its own time"),
]


@pytest.fixture(name="browser", scope="module")
def browser_fixture() -> Iterator[Any]:
    with playwright.sync_playwright() as run:
        browser = run.chromium.launch(executable_path=str(CHROMIUM), args=["--no-sandbox"])
        yield browser
        browser.close()
