"""Stands by hand that go wrong as they do in a field: each is named, costs that stand only, and spoils no figure."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import numpy as np

from companion.component.service import JobResult
from companion.daemon.job import Job
from companion.estimation.records.align_record import FacesRecord
from sim.hands import Hands
from sim.imu_model import MG, ImuModel
from sim.motions import Turn, Vibration
from tests.e2e.test_align_faces import SCALES, read
from tests.e2e.test_align_turn import true_mg
from tests.e2e.test_page import press
from tests.support.by_hand import Meddle, alone, follow
from tests.support.rig import Rig

MOVES_S = 6.0
ID = 0x3A0002 + (7 << 8)
"""Another sensor of the same type."""


async def run(rig: Rig, hands: Hands, meddle: Meddle, **asked: object) -> tuple[JobResult, Job]:
    """Start an alignment as the page does."""
    status, reason = await press(rig, "align", **asked)
    assert status == 200, reason
    job = rig.service.calibrating.manager.running
    assert job is not None
    return await follow(rig, hands, job, meddle), job


def said(rig: Rig) -> str:
    return "\n".join(rig.ground.texts()).lower()


class Clumsy:
    """A person who makes one mistake at each stand; asked again, follows the instruction."""

    def __init__(self, rig: Rig, hands: Hands) -> None:
        self.wrong: dict[int, Callable[[float], object]] = {}
        """Mistake of each stand; called with the aircraft time."""
        self._rig, self._hands = rig, hands

    def __call__(self, number: int, t_s: float) -> object:
        wrong = self.wrong.pop(number, None)
        return None if wrong is None else wrong(t_s)

    def rocks(self, t_s: float) -> None:
        """Rests a hand on the wing, which trembles for half a minute."""
        self._rig.aircraft.add(
            Vibration(start_s=t_s + MOVES_S, duration_s=30.0, frequency_hz=1.0, amplitude_m_s2=0.0, rocking_deg_s=0.3)
        )

    def lets_go(self, t_s: float) -> None:
        """Lean on the tail, and let go of it so slowly that no gyro is sure; a roll would not tilt it nose up."""
        self._rig.aircraft.add(Turn(start_s=t_s, duration_s=MOVES_S, pitch_deg=0.3))
        self._rig.aircraft.add(Turn(start_s=t_s + MOVES_S + 2.0, duration_s=10.0, pitch_deg=-0.3))

    def arms(self, _: float) -> None:
        """And disarms after a while."""
        loop = asyncio.get_running_loop()
        loop.call_later(MOVES_S + 4.0, self._rig.double.arm)
        loop.call_later(MOVES_S + 20.0, self._rig.double.disarm)

    def restarts(self, _: float) -> None:
        """The autopilot."""
        self._rig.double.reboot()

    def tilts_too_early(self, t_s: float) -> bool:
        """After some seconds of the stand, tilts it to another side."""
        self._hands.hold(t_s, 90.0, 0.0)
        self._hands.hold(t_s + MOVES_S + 6.0, -90.0, 0.0)
        return True

    def lifts_it(self, t_s: float) -> bool:
        """And puts it back as it was."""
        self._rig.aircraft.add(Turn(start_s=t_s, duration_s=4.0, pitch_deg=10.0))
        self._rig.aircraft.add(Turn(start_s=t_s + 4.0, duration_s=4.0, pitch_deg=-10.0))
        return True


NAMED = (
    "seconds: hands off",  # moved too early
    "it still moves: set it down, hands off",
    "degrees: hands off, firm ground",
)


async def test_all_that_goes_wrong_on_all_sides(tmp_path: Path) -> None:
    made, hands = alone(tmp_path, placement_deg=0.02, propped_deg=4.0, imu_rate_hz=10.0, parameters=SCALES)
    clumsy = Clumsy(made, hands)

    async with made.running():
        await made.ready()
        clumsy.wrong = {2: clumsy.tilts_too_early, 3: clumsy.lifts_it, 4: clumsy.rocks, 5: clumsy.lets_go,
                        6: clumsy.arms, 7: clumsy.restarts}  # fmt: skip
        result, job = await run(made, hands, clumsy, action="faces", write=True)
        assert result.outcome == "done", result
        assert isinstance(job.product, FacesRecord)
        assert len(made.service.status()["stands"]["done"]) == len(job.product.stands) <= 13
        for words in (*NAMED, "same pose as pose 2"):
            assert words in said(made), words
        np.testing.assert_allclose(read(made, "scale"), 1.0, atol=2e-4)
        np.testing.assert_allclose(read(made, "accel") / MG, true_mg(made), atol=0.15)


async def test_an_imu_that_is_exchanged_between_the_stands_is_named_and_nothing_is_written(tmp_path: Path) -> None:
    made, hands = alone(tmp_path, propped_deg=1.0, placement_deg=0.02, imu_rate_hz=10.0)
    other = ImuModel(made.aircraft, "icm42688p", seed=9, accel_bias_m_s2=[8.0 * MG, -9.0 * MG, 7.0 * MG])

    async with made.running():
        await made.ready()
        old = [read(made, one).tolist() for one in ("accel", "scale")]

        def meddle(stand: int, _: float) -> None:
            if stand == 3:
                made.double.exchange_imu(other, ID)

        result, _ = await run(made, hands, meddle, action="faces", write=True)
        assert result.outcome == "failed"
        assert "imu fc was exchanged in between (device id" in result.reason
        assert f"now {ID}): align again" in result.reason
        assert [read(made, one).tolist() for one in ("accel", "scale")] == old
