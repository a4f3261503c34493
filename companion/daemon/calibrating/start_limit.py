"""How often somebody may start something: no person is ever held up, a script that starts and cancels is."""

from __future__ import annotations

import asyncio
import math
from typing import Final

from companion.component.service import Refusal
from companion.links.system.budget import Budget

STARTS_PER_S: Final = 1.0
"""Nobody presses faster for long."""
BURST: Final = 10.0
MOST_REQUESTERS: Final = 16
"""More than an aircraft has faces and ground stations; newcomers beyond share one budget, as ids can be made up."""


class StartLimit:
    """A budget of starts for each requester."""

    def __init__(self) -> None:
        self._budgets: dict[str, Budget] = {}
        self._newcomers = Budget(STARTS_PER_S, BURST)

    def refuses(self, requester: str) -> Refusal | None:
        """Take one start; or, when the requester has none left, why not."""
        now_s = asyncio.get_running_loop().time()
        budget = self._budget(requester, now_s)
        left = budget.left(now_s)
        if left < 1.0:
            wait_s = math.ceil((1.0 - left) / STARTS_PER_S)
            return Refusal("busy", f"too many requests, wait {wait_s} s")
        budget.take(1, now_s)
        return None

    def _budget(self, requester: str, now_s: float) -> Budget:
        if requester not in self._budgets:
            # Of who has asked for nothing lately there is nothing to be remembered.
            self._budgets = {name: each for name, each in self._budgets.items() if each.left(now_s) < BURST}
            if len(self._budgets) >= MOST_REQUESTERS:
                return self._newcomers
            self._budgets[requester] = Budget(STARTS_PER_S, BURST)
        return self._budgets[requester]
