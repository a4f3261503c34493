"""Every family of devices through a pseudo-terminal into a calibration, and what comes out against the truth.

Real are the daemon, the ports and the clock. To cost little, one daemon calibrates several IMUs at once beside one
gradienter and one compass, and a few daemons run side by side; the families are those of `sim.scenario`, whoever has
added them.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.config import parse
from companion.configured import models
from companion.daemon.job import Job
from companion.daemon.process.service import Service
from companion.estimation.machine import What
from companion.estimation.noise.allan import PROFILES
from companion.estimation.records.record import ImuRecord, Record
from companion.protocols.registry import PROTOCOLS
from companion.storage.profiles import FORMAT_VERSION, ProfileSource, ProfileStore, SavedProfile, saved_profile
from sim.aircraft import Pose, VirtualAircraft
from sim.ardupilot.double import ArduPilotDouble
from sim.devices import SerialDevice
from sim.imu_model import DEG_H, MG, Bias, ImuModel
from sim.pty_device import PtyDevice
from sim.scenario import COMPASSES, GRADIENTERS, IMUS, fit, law_of, site_at
from sim.station import open_udp
from tests.support.extent import extent

POSE = Pose(pitch_deg=5.0, roll_deg=-3.0, heading_deg=40.0)
AT_ONCE = 3
"""Daemons side by side: more would want more than one core."""
WITHIN_S = 90.0

CONFIG = """
[mavlink]
url = "udpout:{host}:{port}"
[vehicle]
latitude_deg = 40.0
longitude_deg = 116.0
height_m = 50.0
[calibration]
min_still_s = 8
max_s = 10
at_arm = "off"
[push]
parameters = false
[storage]
directory = "{folder}/state"
recordings_mb = 0
[control]
socket = "{folder}/control.sock"
"""


@dataclass(frozen=True)
class Run:
    """What one daemon has: IMUs, a gradienter, a compass, by family."""

    imus: tuple[str, ...]
    gradienter: str
    compass: str
    shared: bool = False
    """The gradienter is the device of the same family in another role, on the same port."""


@dataclass(frozen=True)
class FamilyOutcome:
    record: Record
    truth: dict[str, Bias]
    heading_deg: float
    tilt_sigma_deg: float
    devices: dict[str, dict[str, Any]]


def plain_runs() -> list[Run]:
    """Every family once at least, each on a port of its own."""
    imus, gradienters, compasses = list(IMUS), list(GRADIENTERS), list(COMPASSES)
    count = max(len(gradienters), len(compasses))
    return [
        Run(tuple(imus[k::count]) or (imus[0],), gradienters[k % len(gradienters)], compasses[k % len(compasses)])
        for k in range(count)
    ]


def shared_runs() -> list[Run]:
    """Every device that can serve two roles, in both."""
    others = {name: next((other for other in COMPASSES if other != name), name) for name in GRADIENTERS}
    with_imu = [Run((name,), name, others[name], shared=True) for name in GRADIENTERS if name in IMUS]
    return with_imu + [Run((next(iter(IMUS)),), name, name, shared=True) for name in GRADIENTERS if name in COMPASSES]


RUNS = [*plain_runs(), *shared_runs()]


def cases(run: Run) -> Iterator[tuple[str, str]]:
    """The roles, in words, and the families that a run tries."""
    if run.shared:
        yield "imu and gradienter" if run.gradienter in run.imus else "compass and gradienter", run.gradienter
        return
    yield from (("imu", name) for name in run.imus)
    yield "gradienter", run.gradienter
    yield "compass", run.compass


def section(role: str, device: SerialDevice, path: Path, *more: str) -> str:
    mounting = list(fit(role, device.protocol).mounting_deg)
    lines = [f'port = "{path}"', f"baud = {device.baud}", f'protocol = "{device.protocol}"', f"mounting = {mounting}"]
    return "\n".join([*(more[:1] if role == "imu" else [f"[{role}]"]), *lines, *(more[1:] if role == "imu" else more)])


def calm() -> SavedProfile:
    """Learned of the IMUs that are simulated here: a BMI088's noise, and they do not warm up."""
    part = PROFILES["bmi088"]
    return SavedProfile(
        format_version=FORMAT_VERSION,
        name="calm",
        saved_at="2026-11-21T10:00:00+00:00",
        imu="imu",
        gyro=part.gyro,
        accel=part.accel,
        kept_from=part.name,
        kept=(),
        sources=(ProfileSource(file="a.csv", began_at=None, still_s=5400.0, temperature_degc=None),),
        warm_up=(10.0 * DEG_H, 0.1 * MG),
    )


async def carry_out(run: Run, folder: Path, number: int) -> FamilyOutcome:
    aircraft = VirtualAircraft(POSE, site_at(40.0, 116.0, 50.0))
    aircraft.begin(asyncio.get_running_loop().time())
    imus: dict[str, ImuModel] = {
        name: ImuModel(
            aircraft,
            "bmi088",
            seed=100 * number + k,
            gyro_bias_rad_s=[value * DEG_H for value in (160.3, -124.7, 98.3)],
            accel_bias_m_s2=[value * MG for value in (2.4, -2.2, 1.3)],
            mounting_deg=fit("imu", name).model_mounting_deg,
        )
        for k, name in enumerate(run.imus)
    }
    devices: dict[str, SerialDevice] = {name: IMUS[name](model) for name, model in imus.items()}
    compass = devices["compass"] = COMPASSES[run.compass](aircraft, seed=number)
    if run.shared:
        gradienter = compass if run.gradienter == run.compass else devices[run.gradienter]
    else:
        gradienter = devices["gradienter"] = GRADIENTERS[run.gradienter](aircraft, seed=number)
    path_of = {id(device): folder / name for name, device in devices.items()}
    parts = [
        section("imu", devices[name], folder / name, f'[[imu]]\nname = "{name}"\nsource = "serial"', 'profile = "calm"')
        for name in imus
    ]
    parts.append(section("gradienter", gradienter, path_of[id(gradienter)], f'law = "{law_of(gradienter)}"'))
    parts.append(section("compass", compass, folder / "compass"))
    async with contextlib.AsyncExitStack() as stack:
        for name, device in devices.items():
            await stack.enter_async_context(PtyDevice(device, folder / name))
        autopilot = ArduPilotDouble(aircraft, [ImuModel(aircraft, seed=7)], parameters={"INS_GYR_CAL": 0.0})
        link = await open_udp(autopilot, listen=("127.0.0.1", 0))
        stack.callback(link.close)
        host, port = link.local
        (folder / "state").mkdir()
        ProfileStore(folder / "state").write(calm())
        config = parse(
            CONFIG.format(host=host, port=port, folder=folder) + "\n".join(parts), "families.toml", saved_profile
        )
        service = Service(config)
        tasks = [asyncio.create_task(autopilot.run()), asyncio.create_task(service.run())]
        try:
            record = await _calibrated(service, tasks)
            model = models.gradienter_model(config.gradienter)
            assert model is not None
            return FamilyOutcome(
                record,
                {name: each.true_bias_in_vehicle(aircraft.time_at(now_s())) for name, each in imus.items()},
                POSE.heading_deg,
                model.sigma_deg,
                {device["name"]: device for device in service.status()["devices"]},
            )
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)


def now_s() -> float:
    return asyncio.get_running_loop().time()


async def _calibrated(service: Service, tasks: list[asyncio.Task[None]]) -> Record:
    async with asyncio.timeout(WITHIN_S):
        # Armed or not is known, and every device is heard: then there is nothing left to wait for but stillness.
        while not isinstance(job := service.calibrating.manager.start_calibration(What.BOTH, "test"), Job):
            assert not any(task.done() for task in tasks)
            await asyncio.sleep(0.1)
        result = await job.finished
    assert result.outcome == "done", (result, service.status()["devices"])
    assert job.record is not None
    return job.record


def within(found: Any, truth: Any, sigma: Any, times: float = 4.0) -> None:
    off = np.abs(np.subtract(found, truth)) / np.asarray(sigma)
    assert off.max() < times, f"off by {off} sigma"


@pytest.mark.real_clock
@pytest.mark.parametrize("first", range(0, extent(whole=len(RUNS), a_slice=len(plain_runs())), AT_ONCE))
def test_families_on_ptys_calibrate_right(tmp_path_factory: pytest.TempPathFactory, first: int) -> None:
    async def main(runs: list[Run]) -> list[FamilyOutcome]:
        folders = [tmp_path_factory.mktemp("family") for _ in runs]
        return await asyncio.gather(*map(carry_out, runs, folders, range(first, first + AT_ONCE)))

    runs = RUNS[first : first + AT_ONCE]
    for run, outcome in zip(runs, asyncio.run(main(runs)), strict=True):
        for roles, name in cases(run):
            for role in roles.split(" and "):
                check(outcome, role, name, shared=run.shared)


def check(outcome: FamilyOutcome, role: str, name: str, *, shared: bool) -> None:
    pose = outcome.record.pose
    assert pose is not None
    device = outcome.devices[name if role == "imu" else role]
    assert device["good"], device
    assert bool(device["shared_with"]) == shared
    if role == "imu":
        (imu,) = (imu for imu in outcome.record.imus if imu.name == name)
        check_imu(imu, outcome)
    elif role == "gradienter":
        assert None not in (pose.theta_deg, pose.gamma_deg)
        within((pose.theta_deg, pose.gamma_deg), (5.0, -3.0), (pose.sigma_deg.theta, pose.sigma_deg.gamma))
        for imu in outcome.record.imus:
            within(imu.accel_bias_m_s2, outcome.truth[imu.name].accel_m_s2, imu.accel_sigma_use_m_s2)
    else:
        assert pose.psi_deg is not None
        within((pose.psi_deg - outcome.heading_deg + 180.0) % 360.0 - 180.0, 0.0, pose.sigma_deg.psi)


def check_imu(imu: ImuRecord, outcome: FamilyOutcome) -> None:
    """Within its own sigma, which is no larger than what these sensors allow."""
    truth = outcome.truth[imu.name]
    assert imu.gyro_sigma_use_rad_s is not None
    assert imu.accel_sigma_use_m_s2 is not None
    within(imu.gyro_bias_rad_s, truth.gyro_rad_s, imu.gyro_sigma_use_rad_s)
    within(imu.accel_bias_m_s2, truth.accel_m_s2, imu.accel_sigma_use_m_s2)
    # A sigma that covers everything would prove nothing.
    assert max(imu.gyro_sigma_use_rad_s) < 60.0 * DEG_H
    tilt = 9.81 * math.radians(outcome.tilt_sigma_deg)
    assert max(imu.accel_sigma_use_m_s2) < 1.5 * tilt + 1.5 * MG


def test_every_protocol_can_be_simulated_and_is_tried_in_every_role() -> None:
    tried = {(role, name) for run in RUNS for roles, name in cases(run) for role in roles.split(" and ")}
    assert tried == {(kind, name) for kind, names in PROTOCOLS.items() for name in names}
    assert {kind: set(names) for kind, names in PROTOCOLS.items()} == {
        "imu": set(IMUS),
        "gradienter": set(GRADIENTERS),
        "compass": set(COMPASSES),
    }
