"""Requests that ask for what there is not, on the daemon's answers."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

from companion.config import parse
from companion.daemon.process.service import Service
from companion.errors import CompanionError
from tests.support.mqtt_daemon import ALONE


@pytest.mark.parametrize("seconds", ["nan", float("nan"), -5, 0, float("inf"), 10**400, True, "60", [1]])
@pytest.mark.parametrize(
    ("request_", "key", "words"),
    [
        ({"command": "calibrate"}, "timeout_s", "'timeout_s': found .*; allowed: a number of seconds above 0"),
        ({"command": "align", "action": "zero"}, "timeout_s", "is not understood"),
        ({"command": "record"}, "seconds", "not understood"),
    ],
)
def test_a_time_that_is_none_is_refused_in_one_line(
    tmp_path: Path, request_: dict[str, Any], key: str, words: str, seconds: object
) -> None:
    async def main() -> None:
        service = Service(parse(ALONE.format(folder=tmp_path, more=""), "test.toml"))
        with pytest.raises(CompanionError, match=words) as caught:
            async for _ in service.faces.answer({**request_, key: seconds}):
                pass
        assert "\n" not in str(caught.value)

    asyncio.run(main())
