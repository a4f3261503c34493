"""Ask the autopilot, or the daemon that has its port, for its IMUs and their parts."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Final

import msgspec

from companion.cli.asking import Asking
from companion.config.sections import Config, Imu
from companion.config.words import shown
from companion.errors import ConfigError, DaemonDeniedError, DaemonUnreachableError
from companion.formats import Object
from companion.setup.draft import Draft, part_key

COARSE: Final = "It sends whole steps of 206 deg/h and 1 mg: a gyro bias below one step may stay unknown."
"""1 mrad/s and 1 mg: the steps of SCALED_IMU2 and SCALED_IMU3."""


def parts_given(options: Sequence[str]) -> dict[str, str]:
    """Read the --part options: answers by the keys of their questions."""
    given = {}
    for words in options:
        name, _, part = words.partition("=")
        if not part:
            raise ConfigError(f"--part: found {shown(words)}; allowed: IMU=PART, such as fc=icm42688p")
        given[part_key(name)] = part
    return given


async def daemon_status(config: Config) -> Object | None:
    """Ask the running daemon for its status; None: none runs; empty: one runs and refuses to answer."""
    from companion.links.system.control_client import ask

    found: Object = {}
    try:
        async for reply in ask(config.control.path, {"command": "status"}):
            found = reply.get("status", found)
    except DaemonUnreachableError as error:
        return {} if isinstance(error, DaemonDeniedError) else None
    return found


async def ask_autopilot(asking: Asking, draft: Draft, *, by_default: bool) -> dict[str, str | None]:
    """Offer the IMUs that the autopilot has besides the configured ones; return the parts of all that answer, by name.

    Nothing is written to the autopilot. `by_default`: the answer to the offer where nobody gives one.
    """
    asking.say("", "Asking the autopilot which IMUs it has: up to half a minute. Nothing is changed.")
    from companion.daemon.process.check import answering_imus  # takes seconds on a small board

    config = draft.parsed()
    mine = [msgspec.structs.replace(imu, profile=None) for imu in config.imu if imu.source == "autopilot"]
    others = {one["name"]: one for one in draft.other_imus()}
    asked = [*mine, *(Imu(**one) for one in others.values())]
    logging.disable(logging.WARNING)  # the IMUs that do not exist fail to answer
    try:
        parts = await answering_imus(config, asked)
    finally:
        logging.disable(logging.NOTSET)
    for imu in asked:
        if imu.name in parts:
            part = parts[imu.name]
            words = f"{part}, by its device id" if part else "its device id tells no part of the catalogue"
            asking.say(f"  IMU {imu.instance or 1}: {words}")
    if not parts:
        asking.say("  no answer")
    found = [one for name, one in others.items() if name in parts]
    if found:
        numbers = " and ".join(str(one["instance"]) for one in found)
        question = f"It has IMU {numbers} too; calibrate that as well?"
        if await asking.agrees(question, by_default=by_default, hint=COARSE):
            draft.wanted["imu"] += found
    return parts
