"""Nothing is called wrong on the few seconds that a short calibration leaves after its write."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from companion.autopilot.parameters.verify import Verdict
from companion.daemon.offsets import effect
from companion.estimation.machine import State
from tests.e2e.test_calibration import calibrated
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual


def refused_while(condition: Callable[[], bool], monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the scatter of a few samples speak against every write as long as `condition` holds."""
    real = effect.judge_vectors

    def judge(*what: Any) -> list[Verdict]:
        verdicts = real(*what)
        return [dataclasses.replace(one, problems=("by chance",)) for one in verdicts] if condition() else verdicts

    monkeypatch.setattr(effect, "judge_vectors", judge)


def test_what_a_second_look_shows_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def main() -> None:
        looks: list[float] = []

        def at_first() -> bool:
            looks.append(rig.now_s)
            return rig.now_s - looks[0] < 4.0

        rig = Rig(tmp_path, min_still_s=2.0, max_s=4.0, imu_rate_hz=100.0, feed_s=0.05)
        refused_while(at_first, monkeypatch)
        async with rig.running():
            result, _ = await calibrated(await rig.ready())
            assert result.outcome == "done", result
            assert looks[-1] - looks[0] >= 4.0

    run_virtual(main())


def test_what_ten_seconds_show_is_final(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def main() -> None:
        looks: list[float] = []
        words: set[str] = set()

        def ever() -> bool:
            looks.append(rig.now_s)
            job = rig.service.calibrating.manager.job
            words.add(job.words if job else "")
            assert rig.service.calibrating.manager.state is State.VERIFYING
            return True

        rig = Rig(tmp_path, min_still_s=2.0, max_s=4.0, imu_rate_hz=100.0, feed_s=0.05)
        refused_while(ever, monkeypatch)
        async with rig.running():
            before = dict(rig.double.parameters.values)
            result, _ = await calibrated(await rig.ready())
            assert result.outcome == "failed", result
            assert "old values back" in result.reason
            assert effect.LOOK_S - 3.0 < looks[-1] - looks[0] < effect.LOOK_S + 1.0
            assert any("does not show: looking longer" in each for each in words)
            assert rig.double.parameters.values == before

    run_virtual(main())
