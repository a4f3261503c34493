"""What the heartbeats under one vehicle's ids say of arming, whoever has sent them: pure, time comes in.

Anybody on an unsigned link can say "disarmed" under the autopilot's ids, as often as he likes; but the autopilot's own
heartbeats are heard too. So "armed" outweighs "disarmed", and who says both by turns is not believed at all.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

ARMED_HOLDS_S: Final = 3.0
"""How long an armed heartbeat outweighs disarmed ones: autopilots send at least one a second, and two may be lost."""

_CHANGES: Final = 4
_CHANGES_WITHIN_S: Final = 5.0
"""Arming and disarming twice within this time is more than pilots and autopilots do."""
_CONTRADICTION_HOLDS_S: Final = 10.0


class ArmingWatch:
    """Takes the heartbeats of one vehicle and says what may be believed of them."""

    def __init__(self) -> None:
        self._armed: bool | None = None
        self._armed_s = self._contradiction_s = -math.inf
        self._changes_s: deque[float] = deque(maxlen=_CHANGES)

    def heard(self, t_s: float, *, armed: bool) -> None:
        """One heartbeat came."""
        if armed:
            self._armed_s = t_s
        if self._armed is not None and self._armed is not armed:
            self._changes_s.append(t_s)
            if len(self._changes_s) == _CHANGES and t_s - self._changes_s[0] <= _CHANGES_WITHIN_S:
                self._contradiction_s = t_s
        self._armed = armed

    def restarted(self) -> None:
        """What came before says nothing of now; only "armed" still counts, as a restart can be forged too."""
        self._armed = None

    def armed(self, t_s: float) -> bool | None:
        """Whether it is armed; None before the first heartbeat."""
        if t_s - self._armed_s < ARMED_HOLDS_S:
            return True
        return self._armed

    def contradicts_itself(self, t_s: float) -> bool:
        """Whether armed and disarmed heartbeats come by turns, as of two autopilots, or of one and a forger."""
        return t_s - self._contradiction_s < _CONTRADICTION_HOLDS_S
