"""Every family of devices through a pseudo-terminal into a calibration, and what comes out against the truth.

Real are the daemon, the ports and the clock. To cost little, one daemon calibrates several IMUs at once beside one
gradienter and one compass, and a few daemons run side by side; the families are those of `sim.families`, whoever has
added them.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.calibration.request import What
from companion.calibration.solution.record import ImuRecord, Record
from companion.config import parse
from companion.configured import models
from companion.daemon.job import Job
from companion.daemon.process.service import Service
from companion.protocols.registry import PROTOCOLS
from sim.aircraft import Pose, VirtualAircraft
from sim.ardupilot.double import ArduPilotDouble
from sim.devices import SerialDevice
from sim.families import COMPASSES, GRADIENTERS, IMUS, fit, law_of
from sim.imu_model import DEG_H, MG, Bias, ImuModel
from sim.pty_device import PtyDevice
from sim.scenario import site_at
from sim.udp import open_udp

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
min_still_s = 3
max_s = 5
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
class Outcome:
    """What came of it, and what should have."""

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
        Run(
            tuple(imus[k::count]) or (imus[0],),
            gradienters[k % len(gradienters)],
            compasses[k % len(compasses)],
        )
        for k in range(count)
    ]


def shared_runs() -> list[Run]:
    """Every device that can serve two roles, in both."""
    others = {name: next((other for other in COMPASSES if other != name), name) for name in GRADIENTERS}
    with_imu = [Run((name,), name, others[name], shared=True) for name in GRADIENTERS if name in IMUS]
    return with_imu + [Run((next(iter(IMUS)),), name, name, shared=True) for name in GRADIENTERS if name in COMPASSES]


PLAIN, SHARED = plain_runs(), shared_runs()
CASES = [
    *(("imu", name, next(run for run in PLAIN if name in run.imus)) for name in IMUS),
    *(("gradienter", name, next(run for run in PLAIN if name == run.gradienter)) for name in GRADIENTERS),
    *(("compass", name, next(run for run in PLAIN if name == run.compass)) for name in COMPASSES),
    *(("imu and gradienter" if run.gradienter in run.imus else "compass and gradienter", run.gradienter, run)
      for run in SHARED),
]  # fmt: skip


def section(role: str, device: SerialDevice, path: Path, *more: str) -> str:
    """The part of a configuration that fits a device in a role."""
    mounting = list(fit(role, device.protocol).mounting_deg)
    lines = [f'port = "{path}"', f"baud = {device.baud}", f'protocol = "{device.protocol}"', f"mounting = {mounting}"]
    return "\n".join([*(more[:1] if role == "imu" else [f"[{role}]"]), *lines, *(more[1:] if role == "imu" else more)])


async def carry_out(run: Run, folder: Path, number: int) -> Outcome:
    """One daemon from its start to a record."""
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
    compass = devices["compass"] = COMPASSES[run.compass](aircraft, number)
    if run.shared:
        gradienter = compass if run.gradienter == run.compass else devices[run.gradienter]
    else:
        gradienter = devices["gradienter"] = GRADIENTERS[run.gradienter](aircraft, number)
    path_of = {id(device): folder / name for name, device in devices.items()}
    parts = [
        section(
            "imu", devices[name], folder / name, f'[[imu]]\nname = "{name}"\nsource = "serial"', 'profile = "bmi088"'
        )
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
        config = parse(CONFIG.format(host=host, port=port, folder=folder) + "\n".join(parts), "families.toml")
        service = Service(config)
        tasks = [asyncio.create_task(autopilot.run()), asyncio.create_task(service.run())]
        try:
            record = await _calibrated(service, tasks)
            model = models.gradienter_model(config.gradienter)
            assert model is not None
            return Outcome(
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
        while not isinstance(job := service.calibrating.conductor.start_calibration(What.BOTH, "test"), Job):
            assert not any(task.done() for task in tasks)
            await asyncio.sleep(0.1)
        result = await job.finished
    assert result.outcome == "done", (result, service.status()["devices"])
    assert job.record is not None
    return job.record


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[Run, Outcome | BaseException]:
    """All runs, a few at a time."""

    async def main() -> dict[Run, Outcome | BaseException]:
        gate = asyncio.Semaphore(AT_ONCE)

        async def one(number: int, run: Run) -> Outcome:
            async with gate:
                return await carry_out(run, tmp_path_factory.mktemp("family"), number)

        runs = [*PLAIN, *SHARED]
        found = await asyncio.gather(*(one(n, run) for n, run in enumerate(runs)), return_exceptions=True)
        return dict(zip(runs, found, strict=True))

    return asyncio.run(main())


def within(found: Any, truth: Any, sigma: Any, times: float = 4.0) -> None:
    off = np.abs(np.subtract(found, truth)) / np.asarray(sigma)
    assert off.max() < times, f"off by {off} sigma"


@pytest.mark.parametrize(
    ("roles", "name", "run"), CASES, ids=[f"{roles} {name}".replace(" ", "-") for roles, name, _ in CASES]
)
def test_a_family_on_a_pty_calibrates_right(
    outcomes: dict[Run, Outcome | BaseException], roles: str, name: str, run: Run
) -> None:
    outcome = outcomes[run]
    if isinstance(outcome, BaseException):
        raise outcome
    pose, devices = outcome.record.pose, outcome.devices
    assert pose is not None
    for role in roles.split(" and "):
        device = devices[name if role == "imu" else role]
        assert device["good"], device
        assert bool(device["shared_with"]) == run.shared
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


def check_imu(imu: ImuRecord, outcome: Outcome) -> None:
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


def test_every_protocol_can_be_simulated() -> None:
    assert {kind: set(names) for kind, names in PROTOCOLS.items()} == {
        "imu": set(IMUS),
        "gradienter": set(GRADIENTERS),
        "compass": set(COMPASSES),
    }
