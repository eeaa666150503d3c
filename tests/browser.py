"""A headless Chromium for tests: opens a page, and says what is wrong with it.

Through choreographer over the DevTools protocol.
"""

import asyncio
import base64
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

PHONE, DESK = (390, 844), (1200, 900)
WAIT = 60.0  # s


def missing() -> str:
    """Why no page can be opened; empty where one can."""
    try:
        from choreographer.browsers.chromium import Chromium
    except ImportError:
        return "choreographer is not installed (pip install choreographer)"
    if not Chromium.find_browser(skip_local=False):
        return "no Chromium or Chrome found (.ci/run installs one where it can)"
    return ""


needed = pytest.mark.skipif(bool(missing()), reason=missing() or "a browser is there")


@dataclass
class Page:
    """An open page. faults: what its console or an exception said, and requests for the network."""

    tab: Any
    faults: list[str] = field(default_factory=list)

    async def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        answer = await asyncio.wait_for(self.tab.send_command(method, params=parameters), WAIT)
        assert "error" not in answer, (method, answer["error"])
        return answer["result"]

    async def ask(self, script: str) -> Any:
        """Value of a JavaScript expression, awaited where it is a promise."""
        answer = await self.send(
            "Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    async def show(self, size: tuple[int, int], dark: bool = False, paper: bool = False) -> None:
        """Size of the screen in px, and how its reader likes it."""
        width, height = size
        phone = width < 500
        await self.send("Emulation.setDeviceMetricsOverride", width=width, height=height,
                        deviceScaleFactor=2 if phone else 1, mobile=phone)  # fmt: skip
        await self.send("Emulation.setTouchEmulationEnabled", enabled=phone)
        await self.send("Emulation.setEmulatedMedia", media="print" if paper else "screen", features=[
            {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}])  # fmt: skip

    async def print(self) -> bytes:
        """The page as a PDF on A4."""
        answer = await self.send("Page.printToPDF", paperWidth=8.27, paperHeight=11.69)
        return base64.b64decode(answer["data"])


def visit(path: Path, look: Callable[[Page], Awaitable[Any]]) -> Any:
    """Open a file in a new browser and return what `look` finds on it."""
    return asyncio.run(asyncio.wait_for(_visit(path, look), 4.0 * WAIT))


async def _visit(path: Path, look: Callable[[Page], Awaitable[Any]]) -> Any:
    import choreographer

    async with choreographer.Browser(headless=True, enable_gpu=False) as browser:
        page = Page(await browser.create_tab("about:blank"))

        async def fault(message: dict[str, Any]) -> None:
            parameters = message["params"]
            if parameters.get("type") in (None, "error", "warning", "assert"):
                page.faults.append(str(parameters))

        async def request(message: dict[str, Any]) -> None:
            url = message["params"]["request"]["url"]
            if not url.startswith(("file:", "data:", "blob:")):
                page.faults.append(f"asks the network for {url}")

        for event in ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded"):
            page.tab.subscribe(event, fault)
        page.tab.subscribe("Network.requestWillBeSent", request)
        for domain in ("Page", "Runtime", "Log", "Network"):
            await page.send(f"{domain}.enable")
        await page.show(DESK)
        loaded = page.tab.subscribe_once("Page.loadEventFired")
        await page.send("Page.navigate", url=path.resolve().as_uri())
        await asyncio.wait_for(loaded, WAIT)
        return await look(page)
