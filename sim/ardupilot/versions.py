"""ArduPilot's releases, where they differ in what a companion sees (autopilots 1.1, 1.3, 2, 5.3).

4.4 brought the parameters of IMU 4 and 5; 4.6 HIGHRES_IMU, the DENIED for a rate above the loop's and the second word
that forces arming; 4.7 PARAM_ERROR, MAV_SYSID for SYSID_THISMAV, MAVn_ for SRn_ and ARMING_SKIPCHK for ARMING_CHECK.
"""

from __future__ import annotations

from typing import Final, Literal, get_args

Version = Literal["4.3", "4.4", "4.5", "4.6", "4.7", "4.8"]

VERSIONS: Final[tuple[Version, ...]] = get_args(Version)
NEWEST: Final[Version] = "4.8"
"""In development, as the real firmware that was run."""


def since(version: Version, first: Version) -> bool:
    """Whether a release has what came with `first`."""
    return VERSIONS.index(version) >= VERSIONS.index(first)
