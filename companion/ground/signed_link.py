"""Signing for MAVSDK 4.1, which has none: it is given whole messages that were checked, and what it sends is signed.

MAVSDK's own `raw://` connection stands for the link; the link itself is the companion's.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.links.mavlink.link import MavlinkLink, Message
from companion.links.mavlink.signing import Signing
from companion.links.mavlink.transport import run_transport


class SignedLink:
    """Between MAVSDK and the link.

    Args:
        sdk: a `mavsdk.Mavsdk` with a raw connection.
        own: system and component that MAVSDK sends as.
        key: 32 bytes.
    """

    def __init__(self, sdk: Any, own: tuple[int, int], key: bytes) -> None:
        self._sdk = sdk
        self._loop = asyncio.get_running_loop()
        self._from_sdk = mavlink.MAVLink(None)
        self._from_sdk.robust_parsing = True
        self.link = MavlinkLink(system_id=own[0], component_id=own[1])
        self.signing = self.link.signing = Signing(required=True)
        self.signing.key = key
        for kind in mavlink.mavlink_map.values():
            self.link.subscribe(kind, self._hand_over)
        sdk.subscribe_raw_bytes_to_be_sent(self._in_a_thread)

    def words(self) -> str:
        """What was dropped, for people; empty when nothing was."""
        if not self.signing.doubted:
            return ""
        counts = ", ".join(f"{count} {reason}" for reason, count in self.signing.doubted.most_common())
        return f"messages dropped because of their signature: {counts}"

    def _hand_over(self, message: Message, _t_s: float) -> None:
        self._sdk.pass_received_raw_bytes(bytes(message.get_msgbuf()))

    def _in_a_thread(self, data: bytes) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended meanwhile
            self._loop.call_soon_threadsafe(self._send, data)

    def _send(self, data: bytes) -> None:
        for message in self._from_sdk.parse_buffer(data) or ():
            if message.get_msgId() in mavlink.mavlink_map:
                self.link.send(message)


@asynccontextmanager
async def open_signed(sdk: Any, own: tuple[int, int], url: str, key: bytes) -> AsyncIterator[SignedLink]:
    """Carry what MAVSDK sends and hears over a url, signed, until the context ends.

    Raises:
        LinkError: the url is none.
        mavsdk.MavsdkError: MAVSDK refuses the raw connection.
    """
    await asyncio.to_thread(sdk.add_any_connection_with_handle, "raw://")
    signed = SignedLink(sdk, own, key)
    carrying = asyncio.create_task(run_transport(signed.link, url), name="signed link")
    try:
        yield signed
    finally:
        carrying.cancel()
        await asyncio.wait([carrying])
