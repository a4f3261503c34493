"""Work that is done where it holds nobody up."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

Offload = Callable[..., Awaitable[Any]]
"""Runs a blocking call elsewhere: `asyncio.to_thread` in the daemon."""
