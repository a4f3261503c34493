"""What of an IMU's seconds never came, and what came and says nothing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from companion.errors import CalibrationRefusedError
from companion.estimation.seconds.batch import Batch

_LOST_REFUSAL: Final = 0.5
_USUAL_SHARE: Final = 0.95
"""A second that holds fewer samples than this share of the usual lost some; what is above is the grid's phase."""
_AXIS: Final = "xyz"


def refuse_broken(name: str, steps: tuple[float, float], batches: Sequence[Batch]) -> None:
    """Nothing that is stuck or mostly lost is averaged; `steps` are those of a stream of integers, else 0.

    Raises:
        CalibrationRefusedError: an axis never changes, or most samples were lost.
    """
    low = np.min([batch.low for batch in batches], axis=0)
    high = np.max([batch.high for batch in batches], axis=0)
    for column in np.flatnonzero((low == high) & (np.repeat(steps, 3) == 0.0)).tolist():
        part = f"{'gyro' if column < 3 else 'accel'} {name}"
        raise CalibrationRefusedError(f"{part} is stuck: axis {_AXIS[column % 3]} did not change in {len(batches)} s")
    share = lost(batches)
    if share > _LOST_REFUSAL:
        raise CalibrationRefusedError(f"imu {name} lost {share:.0%} of its samples, more than {_LOST_REFUSAL:.0%}")


def lost(batches: Sequence[Batch]) -> float:
    """Share of the samples that never came: by the device's counter, else against the usual number in a second."""
    usual = float(np.median([batch.n for batch in batches]))
    missing = came = 0.0
    for batch in batches:
        came += batch.n
        if batch.missing is not None:
            missing += batch.missing
        elif batch.n < _USUAL_SHARE * usual:
            missing += usual - batch.n
    return missing / (missing + came)
