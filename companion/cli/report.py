"""`companion report`: a page about one calibration, in one file."""

from __future__ import annotations

import argparse
import datetime
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from companion.cli.terminal import DONE, FAILED, USAGE, AddCommand, load_config, print_json, print_lines
from companion.errors import CompanionError, ConfigError, StorageError

if TYPE_CHECKING:
    from companion.calibration.noise.allan import NoiseProfile


def add_command(add: AddCommand) -> None:
    """Add `report`."""
    sub = add("report", report, "make a page (one HTML file) of a calibration: needs no daemon, no network")
    sub.add_argument(
        "record", nargs="?", metavar="RECORD", help="its number, or the beginning of its time (default: the latest)"
    )
    sub.add_argument("-o", "--output", metavar="FILE", help="default: companion-report-….html here; - is stdout")
    sub.add_argument(
        "--storage", type=Path, metavar="DIR", help="the folder with records/ (default: as in the configuration)"
    )


async def report(options: argparse.Namespace) -> int:
    """`companion report`."""
    as_json = getattr(options, "json", False)
    if options.output == "-" and as_json:
        print_lines("companion report: -o - and --json both want stdout", error=True)
        return USAGE
    directory, profiles = _where(options)
    try:
        path, damaged = _make(options, directory, profiles)
    except CompanionError as error:
        print_lines(f"companion: {error}", error=True)
        if as_json:
            print_json({"state": "failed", "reason": str(error), "file": None})
        return FAILED
    skipped = f"skipped: {'; '.join(damaged)}" if damaged else ""
    if skipped:
        print_lines(f"companion: {skipped}", error=True)
    if as_json:
        print_json({"state": "done", "reason": skipped, "file": str(path)})
    elif path is not None:
        print_lines(path)
    return DONE


def _where(options: argparse.Namespace) -> tuple[Path, dict[str, NoiseProfile]]:
    """The storage folder, and the noise profiles that the configuration names.

    Raises:
        ConfigError: there is no configuration to say where, and no --storage.
    """
    from companion.calibration.noise.allan import noise_profile

    try:
        config = load_config(options, profiles=True)
    except ConfigError as error:
        if options.storage is not None:
            # A folder copied to another computer needs no configuration there.
            return options.storage, {}
        raise ConfigError(f"{error} (or name the folder with the records: --storage DIR)") from error
    profiles = {imu.name: noise_profile(imu.profile) for imu in config.imu if imu.profile is not None}
    return options.storage or config.storage.path, profiles


def _make(
    options: argparse.Namespace, directory: Path, profiles: dict[str, NoiseProfile]
) -> tuple[Path | None, list[str]]:
    from companion.report.calibration_page import calibration_page
    from companion.report.source import material
    from companion.storage.state import write_atomically

    now = datetime.datetime.now(tz=datetime.UTC)
    one = material(directory, options.record, profiles)
    content, damaged = calibration_page(one, now), list(one.damaged)
    name = f"companion-report-{one.number:06d}.html"
    if options.output == "-":
        # As the file says of itself, whatever the terminal speaks.
        sys.stdout.buffer.write(content.encode("utf-8", "replace"))
        sys.stdout.flush()
        return None, damaged
    path = Path(options.output or name).absolute()
    if not path.parent.is_dir():
        raise StorageError(f"{path}: there is no folder {path.parent}")
    if path.is_dir():
        path = path / name
    write_atomically(path, content.encode("utf-8", "replace"), mode=0o644)
    return path, damaged
