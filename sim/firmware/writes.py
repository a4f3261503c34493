"""What was written, and what a write sets off when the faults say so."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from sim.firmware.double import AutopilotDouble


class Write(NamedTuple):
    """One PARAM_SET as it arrived: the independent witness of what the companion wrote, and when."""

    t_s: float
    """The loop's clock."""
    name: str
    value: float
    armed: bool
    system_id: int
    component_id: int


def after_write(double: AutopilotDouble) -> bool:
    """Count down the faults that wait for a write; True if this one rebooted the autopilot."""
    faults = double.faults
    if faults.foreign_write_after is not None:
        count, name, value = faults.foreign_write_after
        faults.foreign_write_after = (count - 1, name, value) if count > 1 else None
        if count <= 1:
            double.soon(0.01, lambda: double.write_as_another_station(name, value))
    if faults.arm_after_writes is not None:
        faults.arm_after_writes -= 1
        if faults.arm_after_writes <= 0:
            faults.arm_after_writes = None
            double.arm()
    if faults.reboot_after_writes is not None:
        faults.reboot_after_writes -= 1
        if faults.reboot_after_writes <= 0:
            faults.reboot_after_writes = None
            double.reboot()
            return True
    return False
