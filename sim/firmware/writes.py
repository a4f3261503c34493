"""What was written."""

from __future__ import annotations

from typing import NamedTuple


class Write(NamedTuple):
    """One PARAM_SET as it arrived: the independent witness of what the companion wrote, and when."""

    t_s: float
    """The loop's clock."""
    name: str
    value: float
    armed: bool
    system_id: int
    component_id: int
