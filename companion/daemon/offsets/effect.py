"""Check of new offsets by telemetry: the IMU output must change by the step that the offset changes predict.

The sigma of each window's mean includes the rounding of integer telemetry. The sigmas in the short check of PX4's
temporary large offsets (px4_writes.py) leave this rounding out.
"""

from __future__ import annotations

import asyncio
import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from companion.autopilot.firmware.imu_calibration import output_step
from companion.autopilot.firmware.imu_messages import MRAD
from companion.autopilot.parameters.verify import EffectVerdict, Observation, judge
from companion.autopilot.vehicle.vehicle import ArmState, VehicleTimer
from companion.config.sections import NoiseProfile
from companion.daemon.core import Core
from companion.daemon.offsets.plan import ImuPlan, Plan
from companion.daemon.offsets.px4_writes import Px4Writes, UnderFarOffset
from companion.errors import CalibrationRefusedError
from companion.estimation.collector.measurement import MIN_BATCHES
from companion.estimation.means.warming import Warming
from companion.estimation.means.windows import ImuWindow, Window
from companion.estimation.noise.allan import floor_variance, noise_profile
from companion.messages import message
from companion.physics.frames import Array, vector
from companion.physics.units import DEG_H, MG
from companion.samples import Triad, Vector

VERIFY_MAX_S: Final = 60.0  # Longest wait for stillness after a write; then its effect counts as not seen
VERIFY_ON_DECK_S: Final = 180.0
"""Longest wait for a write's effect on a ship or boat, whose motion hides the step for most of a minute."""
LOOK_S: Final = 10.0
"""Time without movement that is enough to see a write change the IMU output; a calibration may need more."""
LOOK_LONGER_S: Final = 30.0
"""Longest observation of a step that noise hides at first: after this time, flicker noise makes averaging useless."""
TELEMETRY_S: Final = 2.0
"""Time after a write during which missing telemetry is no fault: samples during the write were left out."""
TELEMETRY: Final = "waiting for the telemetry"
"""Progress text shortly after a write, which itself causes missing samples and a step that looks like movement."""
UNWATCHED: Final = "this IMU is not in the telemetry"
POLL_S: Final = 0.2

Verdicts = Mapping[str, list[EffectVerdict]]  # Verdicts by IMU

# Flicker noise assumed for an unknown IMU model between two windows of some ten seconds: floors of 8 deg/h and 50
# micro-g, as of an ordinary model. The worst model's flicker, used for sigma_use over minutes, would hide every step.
ORDINARY_FLICKER: Final[Mapping[Triad, float]] = {"gyro": 8.0 / 0.664 * DEG_H, "accel": 0.05 / 0.664 * MG}
TOLERANCE_SIGMAS: Final = 2.0
"""Allowed difference from the expected output in addition to noise, in sigmas of the bias (its sigma_use)."""


async def verify_effect(
    core: Core, px4: Px4Writes, plan: Plan, before: Window, go_on: Callable[[str], None], boots: int
) -> tuple[Verdicts | None, str]:
    """Wait until the aircraft is motionless after a write, then judge the step; if it is nearly visible, go on longer.

    `go_on` is called regularly with a progress text and may raise to end the wait. `boots`: number of autopilot
    restarts seen before the write. Returns verdicts by IMU, and the reason if there are none or they are not final.
    """
    watched = [target for target in plan.targets if target.watched]
    if not watched:
        return None, UNWATCHED
    loop, vehicle = asyncio.get_running_loop(), core.vehicle
    most_s = VERIFY_MAX_S if core.config.vehicle.platform == "ground" else VERIFY_ON_DECK_S
    written = VehicleTimer(vehicle)
    words = TELEMETRY
    while not written.has_passed(vehicle.kind.settle_s):
        go_on(words)
        await asyncio.sleep(POLL_S)
    since_s = loop.time()
    verdicts: Verdicts | None = None
    while (looked_s := loop.time() - since_s) < most_s:
        go_on(words)
        if vehicle.arm_state is ArmState.ARMED:
            return verdicts, "armed right after the write"
        if vehicle.boots != boots:
            return None, message("disturbed_after_write", event="the autopilot restarted")
        words = _in_the_way(core, looked_s)
        if not words:
            try:
                after = await core.window(since_s=since_s)
            except CalibrationRefusedError as error:
                words = str(error)
            else:
                verdicts = {target.name: _judge(core, px4, target, before, after) for target in watched}
                words = why_look_longer(verdicts, loop.time() - since_s)
                if not words:
                    return verdicts, ""
        await asyncio.sleep(POLL_S)
    return verdicts, f"not still within {most_s:.0f} s after the write ({words})"


def _in_the_way(core: Core, looked_s: float) -> str:
    now_s = asyncio.get_running_loop().time()
    status = core.collector.status(now_s)
    words = status.waiting_for or ""
    if words and status.still_s > 0.0:
        # A step may be visible in less time without movement than a calibration needs.
        moves = core.collector.glance(now_s).obstacle
        words = "" if moves is None else moves.words
        look_s = min(LOOK_S, core.config.calibration.min_still_s)
        if not words and status.still_s < look_s:
            words = f"hold still {look_s - status.still_s:.0f} s more"
    if words and looked_s < TELEMETRY_S:
        return TELEMETRY  # telemetry seems to be missing because samples during the write were left out
    return words


def _judge(core: Core, px4: Px4Writes, target: ImuPlan, before: Window, after: Window) -> list[EffectVerdict]:
    first, second = (next(imu for imu in window.imus if imu.name == target.name) for window in (before, after))
    profile, under_far_offset = core.profiles.of(target.name), px4.under_far_offset[target.calibration.instance]
    apart_s = (after.start_s + after.end_s - before.start_s - before.end_s) / 2.0
    return judge_vectors(target, first, second, profile, under_far_offset, apart_s=apart_s)


def why_look_longer(verdicts: Verdicts, looked_s: float) -> str:
    found = [verdict for each in verdicts.values() for verdict in each]
    # The scatter of two seconds does not show the error of their mean, so it cannot prove that a write is wrong.
    hasty = looked_s < LOOK_S and not all(verdict.ok for verdict in found)
    # Longer observation can reveal a hidden step that already has at least 3 of the 8 sigmas it needs.
    nearly = any(
        verdict.ok and verdict.hidden and verdict.fraction_sigma is not None and verdict.fraction_sigma < 1 / 3
        for verdict in found
    )
    return message("effect_not_clear_yet") if looked_s <= LOOK_LONGER_S and (hasty or nearly) else ""


def judge_vectors(
    target: ImuPlan,
    first: ImuWindow,
    second: ImuWindow,
    profile: str | NoiseProfile | None,
    under_far_offset: UnderFarOffset,
    *,
    apart_s: float = 0.0,
) -> list[EffectVerdict]:
    """Judge the new offsets of one IMU (accelerometer, gyro, or both) by the windows before and after the write.

    On PX4 a small change is in use if the output followed the temporary large offset and then the new offset.
    `apart_s`: time between the middles of both windows.
    """
    gyro_step, accel_step = output_step(target.calibration, target.changes, first.accel_m_s2)
    names, noise = target.calibration.parameters, noise_profile(profile)
    spans_s = (first.duration_s, second.duration_s)
    flicker: Mapping[Triad, float] = {} if profile is not None else ORDINARY_FLICKER
    verdicts: list[EffectVerdict] = []
    halves: tuple[tuple[Triad, Array | None, Vector, tuple[str, str, str], str], ...] = (
        ("accel", target.residual[1], accel_step, names.accel_offset, "m/s^2"),
        ("gyro", target.residual[0], gyro_step, names.gyro_offset, "rad/s"),
    )
    for triad, excess, step, parameters, unit in halves:
        if excess is None:
            continue
        mean, sigma, use = _read(first, triad)
        mean_after, sigma_after, _ = _read(second, triad)
        before, after, warmed = _as_at_end(triad, (first.warming, second.warming), apart_s, mean, mean_after)
        model = noise.of(triad)
        # Bias drift between the windows: docs/reference/method.md section 2.2, V without its white part.
        drift = np.sqrt(floor_variance(min(model.flicker, flicker.get(triad, math.inf)), model.walk, *spans_s))
        observation = Observation(
            parameters=parameters,
            unit=unit,
            before=before,
            before_sigma=sigma,
            after=after,
            after_sigma=vector(np.hypot(np.hypot(_limited_from_below(sigma_after, sigma, spans_s), drift), warmed)),
            expected_step=step,
            truth=vector(np.subtract(before, excess)),
            tolerance=TOLERANCE_SIGMAS * max(use),
            orientation=target.calibration.orientation,
        )
        verdict = judge(observation)
        if verdict.ok and triad in under_far_offset:
            (far, far_sigma), step_from_there = under_far_offset[triad]
            verdict = judge(
                dataclasses.replace(
                    observation,
                    before=vector(far),
                    before_sigma=vector(far_sigma),
                    expected_step=vector(step_from_there),
                    resolution=MRAD if triad == "gyro" else MG,
                )
            )
        verdicts.append(verdict)
    return verdicts


def _read(window: ImuWindow, triad: Triad) -> tuple[Vector, Vector, Vector]:
    if triad == "gyro":
        return window.gyro_rad_s, window.gyro_sigma_stat_rad_s, window.gyro_sigma_use_rad_s
    return window.accel_m_s2, window.accel_sigma_stat_m_s2, window.accel_sigma_use_m_s2


def _as_at_end(
    triad: Triad, warming: tuple[Warming | None, Warming | None], apart_s: float, before: Vector, after: Vector
) -> tuple[Vector, Vector, Array]:
    """Correct both windows' means for warm-up, to the end of the first window; also return this correction's sigma."""
    first, second = warming
    if first is None:
        return before, after, np.zeros(3)
    slope, sigma = first.goes_on(triad)
    later = np.zeros(3) if second is None else second.ahead(triad)
    since_end_s = apart_s - first.half_s
    return (
        vector(before - first.ahead(triad) + slope * first.half_s),
        vector(after - later - slope * since_end_s),
        sigma * apart_s,
    )


def _limited_from_below(after: Vector, before: Vector, spans_s: tuple[float, float]) -> Vector:
    """Raise the sigmas of the mean after a write to at least those expected from the noise before the write.

    A write does not change the noise, but the scatter in a few seconds can by chance be a tenth of the true scatter. If
    the window before the write is short too, its mean noise over the axes is a further lower limit. In simulated good
    writes with windows of 2 s, this reduced refusals from 2 % to 0.1 %. With 5 s or more before the write: 0.2 %.
    """
    longer = float(np.sqrt(spans_s[0] / spans_s[1])) if spans_s[1] > 0.0 else 1.0
    triad = float(np.sqrt(np.mean(np.square(before)))) if spans_s[0] < MIN_BATCHES else 0.0
    x, y, z = (max(sigma, longer * usual, longer * triad) for sigma, usual in zip(after, before, strict=True))
    return x, y, z


def in_short(verdict: EffectVerdict) -> str:
    unused = [name for name, word in verdict.axes.items() if word == "not seen"]
    if unused:
        return message("offsets_not_used", parameters=", ".join(unused))
    wrong = [name for name, word in verdict.axes.items() if word == "wrong"]
    if wrong:
        return message("output_did_not_follow", parameters=", ".join(wrong))
    return "; ".join(verdict.problems)
