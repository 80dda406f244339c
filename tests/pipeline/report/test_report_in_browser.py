"""The report in a real headless Chromium: no error, no request, no sideways scrolling from 400 to 2560 px,
light and dark, and the star image can be zoomed."""

from __future__ import annotations

import asyncio
import json
import shutil
import subprocess
import tempfile
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tornado.websocket import websocket_connect

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="NO CHROMIUM FOUND: the report was not looked at in a browser"
)
SWITCHES = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--remote-debugging-port=0",
    "--host-resolver-rules=MAP * ~NOTFOUND",
)
FACTS = """(() => {
  const wide = document.documentElement;
  const lit = (element) => getComputedStyle(element).color;
  const inside = (element) => {
    for (let e = element.parentElement; e; e = e.parentElement)
      if (e.classList.contains("scroll")) return true;
    return false;
  };
  return {
    scroll: wide.scrollWidth, client: wide.clientWidth,
    sections: [...document.querySelectorAll("section[id]")].filter((s) => s.offsetHeight > 20).length,
    broken: [...document.images].filter((i) => i.complete && i.naturalWidth === 0).length,
    images: document.images.length,
    ink: lit(document.body), paper: getComputedStyle(wide).backgroundColor,
    plot: [...document.querySelectorAll("svg.plot")].map((s) => s.getBoundingClientRect().width),
    sticking_out: [...document.querySelectorAll("main *")].filter(
      (e) => !inside(e) && !e.closest("svg") && e.getBoundingClientRect().right > wide.clientWidth + 1
    ).length,
    label: getComputedStyle(document.querySelector("svg.plot text")).fill,
  };
})()"""


class Browser:
    """One page of a Chromium, spoken to through its debugging protocol."""

    def __init__(self, socket: Any) -> None:
        self.socket, self.count, self.events = socket, 0, []

    async def do(self, method: str, **parameters: Any) -> dict[str, Any]:
        self.count += 1
        await self.socket.write_message(
            json.dumps({"id": self.count, "method": method, "params": parameters})
        )
        while True:
            message = json.loads(await asyncio.wait_for(self.socket.read_message(), 30.0))
            if message.get("id") == self.count:
                assert "error" not in message, message
                return message["result"]
            self.events.append(message)

    async def value(self, expression: str) -> Any:
        got = await self.do("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in got, got
        return got["result"].get("value")

    async def go(self, page: Path, width: int, scheme: str) -> dict[str, Any]:
        await self.do(
            "Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=False
        )
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        await self.do("Emulation.setEmulatedMedia", media="screen", features=features)
        await self.do("Page.navigate", url=page.as_uri())
        while not any(event["method"] == "Page.loadEventFired" for event in self.events):
            self.events.append(json.loads(await asyncio.wait_for(self.socket.read_message(), 30.0)))
        # The override reaches the page's own process a moment after the page has been loaded.
        wait = "new Promise((done) => { const end = Date.now() + 10000; const look = () =>"
        wait += f" innerWidth === {width} || Date.now() > end ? done() : setTimeout(look, 20); look(); }})"
        await self.value(wait)
        facts: dict[str, Any] = await self.value(FACTS)
        return facts

    def complaints(self) -> list[Any]:
        kinds = ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded")
        return [event for event in self.events if event["method"] in kinds]

    def requests(self) -> set[str]:
        sent = [
            e["params"]["request"]["url"] for e in self.events if e["method"] == "Network.requestWillBeSent"
        ]
        return {url for url in sent if not url.startswith("data:")}


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """The debugging address of a fresh Chromium's page."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [str(CHROMIUM), *SWITCHES, f"--user-data-dir={profile}", "about:blank"]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        try:
            assert process.stderr is not None
            line = next(text for text in process.stderr if "DevTools listening on" in text)
            port = line.split("ws://")[1].split("/")[0]
            with urllib.request.urlopen(f"http://{port}/json", timeout=10) as answer:
                yield next(t["webSocketDebuggerUrl"] for t in json.load(answer) if t["type"] == "page")
        finally:
            process.terminate()
            process.wait(10)


async def opened(address: str) -> Browser:
    browser = Browser(await websocket_connect(address, max_message_size=2**26))
    for domain in ("Page", "Runtime", "Log", "Network"):
        await browser.do(f"{domain}.enable")
    browser.events.clear()
    return browser


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [400, 1280, 2560])
def test_the_page_fits_speaks_to_nobody_and_complains_of_nothing(address, finished, width, scheme):
    page = finished[1] / "report.html"

    async def look() -> tuple[dict[str, Any], Browser]:
        browser = await opened(address)
        return await browser.go(page, width, scheme), browser

    facts, browser = asyncio.run(look())
    assert browser.complaints() == []
    assert browser.requests() == {page.as_uri()}
    assert facts["scroll"] <= facts["client"] and width - 20 <= facts["client"] <= width  # 15 px: scroll bar
    assert facts["sticking_out"] == 0
    assert facts["sections"] == 12
    assert facts["broken"] == 0 and facts["images"] > 10
    assert all(250 <= one <= width for one in facts["plot"])  # px: legible, and no wider than the page
    assert brightness(facts["paper"]) > 200 if scheme == "light" else brightness(facts["paper"]) < 60
    assert abs(brightness(facts["ink"]) - brightness(facts["paper"])) > 150  # of 255
    assert facts["label"] == facts["ink"]


def test_the_star_image_is_zoomed_by_button_key_and_pointer(address, finished):
    async def zoom() -> list[str]:
        browser = await opened(address)
        await browser.go(finished[1] / "report.html", 1280, "light")
        box = "document.querySelector('#star-image').getAttribute('viewBox')"
        seen = [await browser.value(box)]
        image = "document.querySelector('#star-image')"
        for action in (
            "document.querySelector('[data-zoom=\"2\"]').click()",
            f"{image}.dispatchEvent(new KeyboardEvent('keydown', {{key: 'ArrowRight'}}))",
            f"{image}.dispatchEvent(new MouseEvent('dblclick'))",
            "document.querySelector('[data-zoom=\"0\"]').click()",
        ):
            await browser.value(action)
            seen.append(await browser.value(box))
        await browser.value("document.querySelector('[data-marks]').click()")
        seen.append(await browser.value("getComputedStyle(document.querySelector('.marks')).display"))
        assert browser.complaints() == []
        return seen

    whole, twice, moved, closer, again, marks = asyncio.run(zoom())
    sizes = [[float(x) for x in box.split()] for box in (whole, twice, moved, closer, again)]
    assert sizes[1][2] == pytest.approx(sizes[0][2] / 2.0)
    assert sizes[2][0] > sizes[1][0] and sizes[2][2] == sizes[1][2]
    assert sizes[3][2] == pytest.approx(sizes[0][2] / 4.0)
    assert sizes[4] == sizes[0]
    assert marks == "none"


def brightness(colour: str) -> float:
    red, green, blue = (float(x) for x in colour[colour.index("(") + 1 : -1].split(",")[:3])
    return 0.3 * red + 0.6 * green + 0.1 * blue
