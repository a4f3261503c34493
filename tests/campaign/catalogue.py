"""All faults, in the order of the table."""

from __future__ import annotations

from tests.campaign import faults_computer, faults_devices, faults_mavlink
from tests.campaign.fault import Fault

FAULTS: dict[str, Fault] = {
    fault.name: fault for fault in (*faults_devices.faults(), *faults_mavlink.faults(), *faults_computer.faults())
}
