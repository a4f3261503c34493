"""The journeys that are tried, with the figures that they are compared with."""

from __future__ import annotations

from sim.aircraft import Pose
from sim.experiments.trials import Setup
from sim.flight import BankedCircles, Drive, Route, Shuttle


def _drive(start_s: float) -> Route:
    return Drive(start_s=start_s)


def _circles(start_s: float) -> Route:
    return BankedCircles(start_s=start_s)


def _shuttle(start_s: float) -> Route:
    return Shuttle(start_s=start_s)


DRIVE = Setup(
    name="drive",
    route=_drive,
    seconds=180.0,
    pose=Pose(0.0, 9.52, 35.0),
    part="adis16405",
    rate_hz=100.0,
)
"""Section 5.2 of the paper: 180 s in a car, the box fixed with 9.52 degrees of roll. The paper names neither route nor
IMU; its turntable's scatter of biases is that of an ADIS16405 (method 1.3), and the route is ours."""

CIRCLES = Setup(
    name="banked circles",
    route=_circles,
    seconds=300.0,
    pose=Pose(0.0, 0.0, 35.0),
    part="icm42688p",
    rate_hz=200.0,
    compass_in_motion=False,
)
"""A fixed wing at 15 m/s and 35 degrees of bank for five minutes, without GPS, airspeed or compass."""

SHUTTLE = Setup(
    name="shuttling",
    route=_shuttle,
    seconds=300.0,
    pose=Pose(0.0, 0.0, 35.0),
    part="icm42688p",
    rate_hz=200.0,
    compass_in_motion=False,
    vibration_m_s2=3.0,
)
"""A multirotor to and fro at 12 degrees of lean, with a vibration of 3 m/s^2, likewise."""
