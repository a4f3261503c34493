"""The autopilot's buzzer guides an operator through an alignment."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.e2e.test_align_turn import FLAT, rig, turn
from tests.support.virtual_time import run_virtual

NOTICE = mavlink.MAV_SEVERITY_NOTICE
HOLD, NEXT, WRONG = "1 long note", "2 short notes, rising", "6 short notes, up and down"
DONE, FAILED = "4 short notes, rising", "4 long notes, falling"


def test_a_turn_is_heard_step_by_step(tmp_path: Path) -> None:
    made, hands = rig(tmp_path, FLAT, "px4")

    async def main() -> None:
        async with made.running():
            await made.ready()
            job = turn(made, 2, write=False)
            await made.until(lambda: job.words.startswith("2 of") and "waiting for it to move" in job.words, 60.0)
            hands.turn(made.aircraft.time_at(made.now_s), 90.0)
            counted = [0]
            while "degrees more" not in job.words:
                counted += [int(seen) for seen in re.findall(r"turned (\d+) of 180 degrees", job.words)]
                await asyncio.sleep(0.2)
            assert counted == sorted(counted), "said while it is made"
            assert abs(counted[-1] - 90) <= 1
            hands.turn(made.aircraft.time_at(made.now_s), 90.0)
            await made.until(lambda: job.words.startswith("3 of"), 60.0)
            hands.turn(made.aircraft.time_at(made.now_s), 180.0)
            assert (await job.finished).outcome == "done"
            await asyncio.sleep(2.0)
            buzzer = made.autopilot.buzzer
            assert buzzer.heard == [HOLD, NEXT, HOLD, WRONG, HOLD, NEXT, HOLD, DONE]
            assert (buzzer.while_armed, buzzer.broken_off) == (0, 0)
            # By the gyros, which may miss a degree.
            texts = [m for _, m in made.ground.received if isinstance(m, mavlink.MAVLink_statustext_message)]
            spoken = [re.sub(r"\b(89|91) degrees", "90 degrees", m.text) for m in texts if m.severity <= NOTICE]
            assert spoken[spoken.index("1 of 3: stand it on a firm, marked spot") :] == [
                "1 of 3: stand it on a firm, marked spot",
                "Hold still",
                "2 of 3: turn it by 180 degrees, onto its marks",
                "Hold still",
                "90 degrees, not 180: turn it by 90 degrees more",
                "Stop turning",
                "Hold still",
                "3 of 3: turn it the same way to its first marks",
                "Stop turning",
                "Hold still",
                "Turn on the spot done:",
            ]

    run_virtual(main())
