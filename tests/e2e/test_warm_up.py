"""The countdown of a warm-up: status, headline and texts to the ground stations, beside the simulator's temperature."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path
from typing import Any

from companion import summary
from companion.daemon.arming.warm_up import SAY_EVERY_S
from sim.thermal import warming
from tests.support.rig import Rig

START_DEGC, END_DEGC, TAU_S, LIMIT_K = 15.0, 33.0, 150.0, 3.0
FEW: dict[str, Any] = {"imus": 1, "min_still_s": 6.0, "max_s": 10.0, "at_arm": "warn"}


async def test_it_counts_down_to_the_truth_and_tells_the_end_once(tmp_path: Path) -> None:
    rig = Rig(tmp_path, temperature_degc=warming(START_DEGC, END_DEGC, TAU_S), **FEW)
    ready_s = TAU_S * math.log((END_DEGC - START_DEGC) / LIMIT_K)
    async with rig.running():
        began_s, shown, left_s = rig.now_s, 0, math.inf
        while (age_s := rig.now_s - began_s) < ready_s + 60.0:
            await asyncio.sleep(10.0)
            status = rig.service.status()
            found, age_s = status["arming"]["warm_up"], rig.now_s - began_s
            if found is None:
                assert age_s < 80.0 or age_s > ready_s - 60.0
                continue
            shown += 1
            left_s = ready_s - age_s
            assert found["low_s"] - 15.0 <= left_s <= found["high_s"] + 15.0
            assert ("ok", "warm-up", found["words"], "") in summary.rows(status)
            headline = status["headline"]
            assert (found["words"] in headline["reason"]) is (headline["word"].split()[0] in ("HOLD", "NOT", "WAIT"))
        assert shown >= 10
        assert rig.service.status()["arming"]["warm_up"] is None
        texts = [text for text in rig.ground.texts() if " warms " in text or text == "Warm-up over"]
        assert texts.count("Warm-up over") == 1
        assert texts[-1] == "Warm-up over"
        assert 3 <= len(texts) <= ready_s / SAY_EVERY_S + 2


async def test_the_autopilots_heater_is_read_once_while_it_warms(tmp_path: Path) -> None:
    """At full power the board would reach 60 degC; the autopilot arms from 43 degC on, 2 K below its target."""
    rig = Rig(
        tmp_path,
        temperature_degc=lambda t_s: min(warming(10.0, 60.0, 400.0)(t_s), 45.0),
        parameters={"BRD_HEAT_TARG": 45.0, "BRD_HEAT_LOWMGN": 2.0},
        **FEW,
    )
    async with rig.running():
        await rig.until(lambda: rig.service.status()["arming"]["warm_up"] is not None, 120.0)
        await asyncio.sleep(60.0)
        found, t_s = rig.service.status()["arming"]["warm_up"], rig.aircraft.time_at(rig.now_s)
        ready_s = 400.0 * math.log(50.0 / (60.0 - 43.0))
        assert found["low_s"] - 15.0 <= ready_s - t_s <= found["high_s"] + 15.0
        assert found["high_s"] < 400.0 * math.log(50.0 / LIMIT_K) - t_s
