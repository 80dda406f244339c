"""The page of trends in a real headless Chromium: widths, both schemes, axe, and points by keyboard."""

import sys
from pathlib import Path

import pytest
from command_line import invoked
from drawn_mission import utc_at
from test_archive import mission_in

sys.path.append(str(Path(__file__).parents[2] / "pipeline" / "report"))
from test_report_in_browser import CHROMIUM, brightness, browser, chromium, violations

__all__ = ["browser", "chromium"]  # fixtures
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="NO CHROMIUM FOUND: the page was not looked at")


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """A year with a step, a refuted result and an exchanged star camera."""
    folder = tmp_path_factory.mktemp("trends")
    truth = mission_in(folder / "archive", 60, refuted=(7,), exchanged=50, step=3.0)
    asked = ("trends", folder / "archive", "--out", folder, "--at", utc_at(truth.t_s[-1]))
    told = invoked(*asked, "--require-arcsec", 2)
    assert told.exit_code in (0, 4), told.output
    return folder / "trends.html"


@pytest.mark.parametrize(("width", "scheme"), [(400, "light"), (1280, "dark"), (2560, "light")])
def test_the_page_of_trends_fits_and_is_walked_by_keyboard(browser, page, width, scheme):
    facts, found, labels = browser.go(page, width, scheme), violations(browser), list[str]()
    for _ in range(12):
        for kind in ("rawKeyDown", "keyUp"):
            browser.do("Input.dispatchKeyEvent", type=kind, key="Tab", windowsVirtualKeyCode=9)
        labels.append(
            browser.value("document.activeElement.closest('svg a') ? document.activeElement.ariaLabel : ''")
        )
    labels = [label for label in labels if label]
    assert browser.requests() == {page.as_uri()}
    assert found == []
    assert facts["scroll"] <= facts["client"] and facts["sticking_out"] == 0 and facts["broken"] == 0
    assert len(facts["plot"]) == 3 and all(one > 250 for one in facts["plot"])
    assert (brightness(facts["paper"]) > 200) == (scheme == "light")
    assert len(labels) > 5 and all("±" in label for label in labels)
