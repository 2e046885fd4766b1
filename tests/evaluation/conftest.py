"""A browser for the pages: of the tests of one module, because Playwright runs once in a process."""

import shutil

import pytest

from tests.needs import BROWSERS, require, require_module


@pytest.fixture(scope="module")
def browser():
    require("browser")
    executable = next(filter(None, map(shutil.which, BROWSERS)))
    driver = require_module("playwright.sync_api")
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run"]
    with driver.sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=executable, args=flags)
        yield running
        running.close()
