"""The person at the ground station: asks, repeats, waits for the one final answer."""

from __future__ import annotations

import asyncio
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.campaign.stage import Stage
from tests.support.component import IN_PROGRESS

REPEAT_S: Final = 1.2
GIVE_UP_S: Final = 12.0
"""After the last sign of life."""


class Operator:
    """Uses command 31010 to 31012 as ground stations do: a repeat with `confirmation` until the first answer comes."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage

    async def ask(self, command: int, *, within_s: float = 300.0, tries: int = 6) -> int | None:
        """The final result; None: nobody answers any more."""
        ground, loop = self._stage.ground, asyncio.get_running_loop()
        began_s = loop.time()
        seen = len(ground.received)
        sent = 0
        heard_s = sent_s = began_s - 100.0
        while loop.time() - began_s < within_s:
            now_s = loop.time()
            answered = heard_s > began_s
            if not answered and now_s - sent_s >= REPEAT_S:
                if sent == tries:
                    return None
                ground.command(command, 0.0, confirmation=sent)
                sent, sent_s = sent + 1, now_s
            if answered and now_s - heard_s > GIVE_UP_S:
                return None
            for t_s, message in ground.received[seen:]:
                if not isinstance(message, mavlink.MAVLink_command_ack_message) or message.command != command:
                    continue
                if (message.target_system, message.target_component) != (ground.system_id, ground.component_id):
                    continue
                if message.result != IN_PROGRESS:
                    return int(message.result)
                heard_s = max(heard_s, t_s, began_s + 1e-6)
            seen = len(ground.received)
            await asyncio.sleep(0.1)
        return None
