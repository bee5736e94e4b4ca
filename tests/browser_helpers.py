# SPDX-License-Identifier: Apache-2.0
"""A real browser without a screen: the installed Chromium, driven by Playwright.

with chromium() as browser:
    page = Page(browser, "http://127.0.0.1:8080/")
    page.button("pause").click()
    image = page.picture()
"""

import base64
import os
import shutil
from contextlib import contextmanager

import cv2
import numpy as np
import pytest

#: Playwright's own download of a browser is not used.
PROGRAMS = ("chromium", "chromium-browser", "google-chrome")

# Pictures without a graphics card.
OPTIONS = (
    "--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)  # fmt: skip

SIZE = {"width": 1000, "height": 640}

#: Pixels drawn along one of the page's layout: few, because the processor draws every one.
RESOLUTION = 0.5

#: Longest wait for anything on a page [ms].
PATIENCE = 60_000


@contextmanager
def chromium():
    """A Playwright browser; skips the test where it or Chromium is missing."""
    program = next(filter(None, map(shutil.which, PROGRAMS)), None)
    if program is None:
        pytest.skip(f"no browser on this machine, expected one of {', '.join(PROGRAMS)}")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    quiet = {**os.environ, "DEBUG": ""}
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=list(OPTIONS), env=quiet)
        try:
            yield browser
        finally:
            browser.close()


class Page:
    """A page of the viewer in a window of its own.

    Attributes:
        errors: what the page's scripts complained of.
    """

    def __init__(self, browser, url):
        self.context = browser.new_context(viewport=SIZE, device_scale_factor=RESOLUTION)
        self.context.set_default_timeout(PATIENCE)
        self.page = self.context.new_page()
        self.errors = []
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self._devtools = self.context.new_cdp_session(self.page)
        self.page.goto(url)

    def close(self):
        self.context.close()

    def text(self):
        """All text on the page."""
        return self.page.inner_text("body")

    def wait_for(self, text):
        """Until a text is seen."""
        self.page.get_by_text(text).first.wait_for()

    def button(self, name):
        return self.page.get_by_role("button", name=name, exact=True)

    def tab(self, name):
        self.page.get_by_role("tab", name=name, exact=True).click()

    def field(self, label):
        """The input beside a label."""
        row = f"//label[normalize-space()='{label}']/ancestor::div[.//input][1]"
        return self.page.locator(f"xpath={row}//input[not(@type='hidden')]").first

    def slider(self, label):
        """The handle of the slider under the field with a label."""
        below = f"xpath=//label[normalize-space()='{label}']/following::div[contains(@class,"
        return self.page.locator(f"{below}'multi-slider-thumb')]").first

    def choose(self, label, option):
        """Pick from a list."""
        self.field(label).click()
        self.page.get_by_role("option", name=option, exact=True).click()

    def drag(self, points, pause=120):
        """Press the mouse at the first of some points [pixels], move over the others, release."""
        mouse = self.page.mouse
        mouse.move(*points[0])
        self.page.wait_for_timeout(pause)  # what is under the mouse is found with the next frame
        mouse.down()
        for point in points[1:]:
            self.page.wait_for_timeout(pause)
            mouse.move(*point)
        self.page.wait_for_timeout(pause)
        mouse.up()

    def picture(self):
        """What the page shows of the scene, (h, w, 3) int BGR; panels and notices are white."""
        data = self._devtools.send("Page.captureScreenshot", {"optimizeForSpeed": True})["data"]
        image = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
        image = image.astype(int)
        image[:, SIZE["width"] - 340 :] = 255
        image[:150, :320] = 255
        return image


def blue(image):
    """Where water and water-like particles are."""
    b, _, r = image.transpose(2, 0, 1)
    return (b > r + 50) & (b > 90)


def orange(image):
    """Where the ball is."""
    b, _, r = image.transpose(2, 0, 1)
    return (r > b + 80) & (r > 120)
