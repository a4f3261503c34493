"""`companion autopilot-setup`: what an autopilot needs set to take in our heading, and what of it is not set.

People set it, with the ground station that they set everything else with.
"""

from __future__ import annotations

from typing import Final

from companion.autopilot.firmware.heading_parameters import RISKS, changes_for, wanted_for
from companion.daemon.core import Core
from companion.links.system.request import Object

REBOOT: Final = "restart the autopilot then: until that it goes on as before"


async def autopilot_setup(core: Core) -> Object:
    """What is set, what should be, and what to do.

    Raises:
        AutopilotError: it does not answer, or cannot take in a heading.
    """
    firmware = core.vehicle.firmware
    wanted = wanted_for(firmware)
    found = await core.parameters.read_many([one.parameter for one in wanted], optional=True)
    changes = changes_for(firmware, found)
    if changes:
        todo = ", ".join(f"{change.parameter} {change.after:g}" for change in changes)
        reason = f"set {todo}; {REBOOT}"
    elif core.config.push.attitude == "off":
        reason = 'the autopilot is set up, but push.attitude is "off": the heading never comes'
    else:
        reason = "the autopilot is set up"
    return {
        "kind": "result",
        "state": "not applied" if changes else "applied",
        "reason": reason,
        "firmware": firmware,
        "parameters": [
            {
                "parameter": one.parameter,
                "now": now,
                "wanted": None if now is None else one.after(now),
                "why": one.why,
            }
            for one in wanted
            for now in (found.get(one.parameter),)
        ],
        "risks": list(RISKS.get(firmware or "other", ())),
    }
