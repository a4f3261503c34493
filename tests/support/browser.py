"""A headless Chromium that presses what a finger would, over its debugging pipe.

The DevTools protocol goes over two inherited descriptors, one JSON object and a NUL each: no port, no driver, no
package, and the browser ends when the pipe does.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import fcntl
import itertools
import json
import os
import shutil
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any, Final

PHONE: Final = (390, 844)
DESKTOP: Final = (1280, 800)
REPLY_WITHIN_S: Final = 120.0
"""Longer than `Tab.until` waits: it says what the page shows instead."""
LIMIT: Final = 32 * 1024 * 1024

FLAGS: Final = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-extensions",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-default-apps",
    "--disable-dev-shm-usage", "--mute-audio", "--remote-debugging-pipe",
)  # fmt: skip

Object = dict[str, Any]


def find() -> str | None:
    """The browser's path; None where there is none."""
    return shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


class Tab:
    def __init__(self, browser: Browser, session: str, target: str) -> None:
        self._browser, self._session, self._target = browser, session, target

    async def call(self, method: str, **parameters: Any) -> Object:
        return await self._browser.call(method, self._session, **parameters)

    async def open(self, url: str, size: tuple[int, int] = PHONE) -> None:
        await self.size(size)
        await self.call("Page.navigate", url=url)

    async def size(self, size: tuple[int, int]) -> None:
        """Let the screen be of that size; below 800 px it is a phone's."""
        phone = size[0] < 800
        await self.call(
            "Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1, mobile=phone
        )
        await self.call("Emulation.setTouchEmulationEnabled", enabled=phone)

    async def value(self, expression: str) -> Any:
        reply = await self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in reply, reply["exceptionDetails"]
        return reply["result"].get("value")

    async def until(self, expression: str, within_s: float = 90.0) -> Any:
        """Wait until an expression is true, looked at whenever the page is drawn; its value."""
        script = f"""new Promise((done, fail) => {{
            const end = performance.now() + {within_s * 1000};
            (function look() {{
                let value; try {{ value = {expression}; }} catch (error) {{ value = null; }}
                if (value) done(typeof value === 'object' ? true : value);
                else if (performance.now() > end) done(null);
                else setTimeout(look, 20);
            }})();
        }})"""
        value = await self.value(script)
        assert value, f"not within {within_s} s: {expression}; the page says: {await self.value(_SEEN)}"
        return value

    async def middle(self, selector: str) -> tuple[float, float]:
        box = await self.value(
            f"(() => {{ const r = document.querySelector({selector!r}).getBoundingClientRect();"
            " return [r.x + r.width / 2, r.y + r.height / 2]; })()"
        )
        return box[0], box[1]

    async def touch(self, selector: str) -> None:
        x, y = await self.middle(selector)
        await self.call("Input.dispatchTouchEvent", type="touchStart", touchPoints=[{"x": x, "y": y}])

    async def roll(self, selector: str, x_px: float) -> None:
        """Move the finger, which is on it, by so much."""
        x, y = await self.middle(selector)
        await self.call("Input.dispatchTouchEvent", type="touchMove", touchPoints=[{"x": x + x_px, "y": y}])

    async def lift(self) -> None:
        await self.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    async def mouse(self, selector: str, kind: str) -> None:
        """`mousePressed` or `mouseReleased` on it."""
        x, y = await self.middle(selector)
        await self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    async def picture(self, path: Path) -> None:
        reply = await self.call("Page.captureScreenshot", format="png")
        path.write_bytes(base64.b64decode(reply["data"]))  # noqa: ASYNC240 - a local file


_SEEN: Final = "document.querySelector('#head').innerText + ' | ' + document.querySelector('#bar').innerText"


class Browser:
    def __init__(self, reader: asyncio.StreamReader, to_browser: int) -> None:
        self._reader, self._to_browser = reader, to_browser
        self._numbers = itertools.count(1)
        self._waiting: dict[int, asyncio.Future[Object]] = {}

    async def listen(self) -> None:
        """Hand out replies until the browser ends."""
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                message = json.loads((await self._reader.readuntil(b"\0"))[:-1])
                waiting = self._waiting.pop(message.get("id", 0), None)
                if waiting is not None and not waiting.done():
                    waiting.set_result(message)

    async def call(self, method: str, session: str | None = None, **parameters: Any) -> Object:
        number = next(self._numbers)
        message: Object = {"id": number, "method": method, "params": parameters}
        if session is not None:
            message["sessionId"] = session
        reply: asyncio.Future[Object] = asyncio.get_running_loop().create_future()
        self._waiting[number] = reply
        os.write(self._to_browser, json.dumps(message).encode() + b"\0")
        async with asyncio.timeout(REPLY_WITHIN_S):
            answer = await reply
        assert "error" not in answer, (method, answer["error"])
        result: Object = answer["result"]
        return result

    async def tab(self) -> Tab:
        target = (await self.call("Target.createTarget", url="about:blank"))["targetId"]
        session = (await self.call("Target.attachToTarget", targetId=target, flatten=True))["sessionId"]
        return Tab(self, session, target)


@contextlib.asynccontextmanager
async def chromium(folder: Path) -> AsyncIterator[Browser]:
    path = find()
    assert path is not None
    (into_out, into_in), (from_out, from_in) = _pipe(), _pipe()
    command = [path, *FLAGS, f"--user-data-dir={folder}", "about:blank"]
    # It reads commands from descriptor 3 and writes to 4.
    shell = ["bash", "-c", f'exec "$@" 3<&{into_out} 4>&{from_in}', "chromium", *command]
    log = (folder.parent / "chromium.log").open("wb")
    process = await asyncio.create_subprocess_exec(
        *shell, pass_fds=(into_out, from_in), stdin=asyncio.subprocess.DEVNULL, stdout=log, stderr=log,
        env={**os.environ, "HOME": str(folder.parent)},
    )  # fmt: skip
    log.close()
    os.close(into_out)
    os.close(from_in)
    reader = asyncio.StreamReader(limit=LIMIT)
    transport, _ = await asyncio.get_running_loop().connect_read_pipe(
        lambda: asyncio.StreamReaderProtocol(reader), os.fdopen(from_out, "rb", buffering=0)
    )
    browser = Browser(reader, into_in)
    listening = asyncio.create_task(browser.listen())
    try:
        yield browser
    finally:
        with contextlib.suppress(AssertionError, TimeoutError, OSError):
            await browser.call("Browser.close")
        os.close(into_in)
        try:
            async with asyncio.timeout(5.0):
                await process.wait()
        except TimeoutError:
            process.kill()
            await process.wait()
        listening.cancel()
        await asyncio.gather(listening, return_exceptions=True)
        transport.close()


def _pipe() -> tuple[int, int]:
    """A pipe whose ends lie above the two descriptors that the browser wants."""
    low = os.pipe()
    ends = tuple(fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10) for end in low)
    for end in low:
        os.close(end)
    return ends[0], ends[1]
