"""Flights that were read from logs, in what the daemon says of the past."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from companion.storage.flights import FlightStore
from tests.support.flights import kept_flight
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual


def test_the_daemon_tells_of_flights_that_were_read_while_it_ran(tmp_path: Path) -> None:
    async def main() -> list[dict[str, Any]]:
        async with Rig(tmp_path).running() as rig:
            answers = []
            for key in ("a", "b"):
                async for reply in rig.service.faces.answer({"command": "history"}):
                    answers.append(reply)
                FlightStore(rig.service.core.config.storage.path).save(kept_flight(key))
            for request in ({"command": "history"}, {"command": "history", "limit": 1}):
                async for reply in rig.service.faces.answer(request):
                    answers.append(reply)
            return answers

    nothing, one, two, latest = run_virtual(main())
    assert nothing["flights"] == []
    assert [each["number"] for each in one["flights"]] == [1]
    assert [each["flight"]["key"] for each in two["flights"]] == ["b", "a"]
    assert [each["flight"]["key"] for each in latest["flights"]] == ["b"]
    (imu,) = one["flights"][0]["flight"]["imus"]
    assert imu["drift"]["flown"][1]["median_m"] == 2.1
