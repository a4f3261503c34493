"""Draft of a configuration: the present or the sample file, changed by detected devices and the operator's answers."""

from __future__ import annotations

import copy
import functools
import itertools
import math
import os
import re
import stat
import tomllib
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, get_args

from companion import config
from companion.config.sections import UNKNOWN, Config, Law, Platform
from companion.config.words import shown
from companion.errors import CompanionError, ConfigError
from companion.installation import install as installing
from companion.links.mavlink.transport import parse_url
from companion.protocols.guess import Line
from companion.protocols.registry import PROTOCOLS, Kind
from companion.rotations import ROTATIONS_DEG
from companion.setup.document import Table, render
from companion.storage.state import read_regular, write_atomically

_PLACEHOLDER: Final = "axis"  # Law until the operator or the guided test names it
PLATFORMS: Final = {"boat": "deck", "ship": "deck", "car": "deck"}
_LAWS: Final = (
    "axis: elevation of each axis above the horizon (servo, MEMS inclinometers). slope: slope of the liquid's surface"
    " (five-pin electrolytic vials). euler: pitch and roll (attitude sensors, compasses). test: two tilts find out."
)
_DECK: Final = (
    "deck: everything that sways or turns while the aircraft stands on it: a boat, a dock, a car with its engine on."
    " It takes longer, and gyros need a compass."
)
_MOUNTING: Final = (
    "Look down on the aircraft, nose up. 0: the sensor's front points to the nose, 90: to the right wing, 180: to the"
    " tail. A wrong answer gives each axis the bias of another; check and align zero find most of that."
)
_PART: Final = (
    "The chip that measures, such as ICM-42688-P, not the board. Its known noise makes sigma smaller; a wrong name"
    " makes it too small. unknown is always right."
)
_LASTING: Final = {"name", "source", "mounting", "profile", "autopilot_instance"}
LAW_KEY: Final = "gradienter.law"
_NAMES: Final[dict[Kind, str]] = {"gradienter": "gradienter", "compass": "compass", "imu": "companion's own IMU"}


@dataclass(frozen=True, slots=True)
class Question:
    """A question of the set-up for the operator, with its present answer and the allowed answers."""

    words: str
    now: str  # Present answer
    put: Callable[[str], Any]
    """Function that stores the operator's answer in the draft, or returns it; it raises ConfigError for a wrong one."""
    hint: str = ""
    choices: Sequence[str] = ()  # Answers that a page shows as buttons
    more: str = ""  # Answer to "?" and "help"
    key: str = ""


class Draft:
    """Draft of a configuration file: its present text, and the values to write. `is_new`: the text is the sample."""

    def __init__(self, text: str, *, is_new: bool) -> None:
        self.text, self.is_new = text, is_new
        self.wanted: Table = tomllib.loads(text)
        self.guessed: set[str] = set()

    def result(self) -> str:
        """Return the text with the changed values; raise CompanionError if its lines cannot be edited one by one."""
        return render(self.text, self.wanted)

    def parsed(self) -> Config:
        """Parse the changed text; raise ConfigError with one line if it is no valid configuration."""
        # Do not look up saved profiles: the daemon does.
        return config.parse(self.result(), "answer", lambda _, name: name)

    @property
    def url(self) -> str | None:
        return None if self.is_new else str(self.wanted["mavlink"]["url"])

    @property
    def lines(self) -> dict[str, Line]:
        if self.is_new:
            return {}
        found = {}
        kind, where, number = parse_url(self.wanted["mavlink"]["url"])
        if kind == "serial":
            found[where] = Line(number, "none")
        kinds: Sequence[Kind] = ("gradienter", "compass", "imu")
        for each in kinds:
            if (section := self.section(each)) is not None:
                info = PROTOCOLS[each][section["protocol"]]
                found[section["port"]] = Line(section.get("baud", info.baud), section.get("parity", info.parity))
        return found

    def take_url(self, url: str) -> None:
        """Set the MAVLink url of the autopilot; raise ConfigError for an invalid url."""
        self._put("mavlink", "url", url)
        self.is_new = False

    def keep_beside(self, path: Path) -> None:
        """Put storage and control socket beside the configuration file: its owner may lack the service's folders."""
        self._put("storage", "directory", str(storage_beside(path)))
        self._put("control", "socket", str(path.absolute().with_name("companion.sock")))

    def show_page(self, bind: str) -> None:
        """Add the web page at the address `bind` unless the file has a page; raise ConfigError for a wrong address."""
        if "web" not in self.wanted:
            self._put("web", "bind", bind)

    def section(self, kind: Kind) -> Table | None:
        if kind == "imu":
            return next((imu for imu in self.wanted["imu"] if imu.get("source") == "serial"), None)
        found: Table | None = self.wanted.get(kind)
        return found

    def take(self, kind: Kind, port: str, protocol: str, line: Line) -> None:
        """Write a detected device to its section; if the protocol changes, delete the previous device's settings."""
        section = self.section(kind)
        if section is None:
            section = {"name": "own", "source": "serial"} if kind == "imu" else {}
            if kind == "imu":
                self.wanted["imu"].append(section)
            else:
                self.wanted[kind] = section
        elif section["protocol"] != protocol:
            for key in section.keys() - _LASTING:
                del section[key]
        is_there = "protocol" in section
        section |= {"port": port, "protocol": protocol}
        info = PROTOCOLS[kind][protocol]
        for key in ("baud", "parity")[: 1 if kind == "imu" else 2]:
            value = getattr(line, key)
            # Do not add a factory setting to a device that is configured already: the default is the same.
            if key in section or not is_there or value != getattr(info, key):
                section[key] = value
        if kind == "gradienter" and "law" not in section:
            known = PROTOCOLS["gradienter"][protocol].law
            section["law"] = known or _PLACEHOLDER
            if known is None:
                self.guessed.add(LAW_KEY)

    def other_imus(self) -> list[Table]:
        imus = self.wanted["imu"]
        taken = {
            imu.get("instance", 1) if imu["source"] == "autopilot" else imu.get("autopilot_instance") for imu in imus
        }
        names = {imu["name"] for imu in imus}
        return [
            {"name": name, "source": "autopilot", "instance": instance}
            for instance in (1, 2, 3)
            if instance not in taken and (name := f"fc{instance}") not in names
        ]

    def questions(self) -> Iterator[Question]:
        yield Question(
            "Where is it calibrated: on the ground, or on a deck (a boat)?",
            self.wanted.get("vehicle", {}).get("platform", "ground"),
            self._put_platform,
            choices=get_args(Platform),
            more=_DECK,
            key="vehicle.platform",
        )
        if (gradienter := self.section("gradienter")) is not None:
            known = PROTOCOLS["gradienter"][gradienter["protocol"]].law
            unknown = "Its data sheet tells; a wrong one costs milli-g. A test finds out: two tilts by 20 deg."
            yield Question(
                "What do the gradienter's readings mean: axis, slope, euler or test?",
                "" if LAW_KEY in self.guessed else gradienter["law"],
                self.put_law,
                f"Its documents say {known}." if known else unknown,
                (*get_args(Law), "test"),
                more=_LAWS,
                key=LAW_KEY,
            )
        kinds: Sequence[Kind] = ("gradienter", "compass", "imu")
        for kind in kinds:
            if (section := self.section(kind)) is not None:
                yield Question(
                    f"How is the {_NAMES[kind]} turned in the aircraft, seen from above: 0, 90, 180 or 270?",
                    mounting_words(section.get("mounting", "ROTATION_NONE")),
                    functools.partial(self.put_mounting, kind),
                    "Degrees clockwise; 0: its front is to the aircraft's front. Or ROLL PITCH YAW, or ROTATION_...",
                    ("0", "90", "180", "270"),
                    more=_MOUNTING,
                    key=f"{kind}.mounting",
                )

    def part_questions(self, names: Collection[str]) -> Iterator[Question]:
        """Yield the question for the type of each of these IMUs, which tells the estimator its noise."""
        from companion.configured.models import gyro_sigmas_deg_h  # importing numpy takes a second on a small board

        sigmas = gyro_sigmas_deg_h(self.parsed())
        price = ", ".join(f"{part} {sigma:.0f}" for part, sigma in sigmas.items())
        for imu in self.wanted["imu"]:
            if (name := imu["name"]) not in names:
                continue
            key, now = part_key(name), imu.get("profile", UNKNOWN)
            if "profile" not in imu:
                self.guessed.add(key)
            choices = list(dict.fromkeys((*sigmas, UNKNOWN, now)))
            whose = f"IMU {imu.get('instance', 1)} of the autopilot" if imu["source"] == "autopilot" else "the own IMU"
            yield Question(
                f"Which part is {whose} ({name})?",
                now,
                functools.partial(self._put_part, imu, key, choices),
                f"Its board's data sheet says; any other part: {UNKNOWN}, whose noise is learned at rest. Gyros known,"
                f" at best, to: {price} deg/h.",
                choices,
                more=_PART,
                key=key,
            )

    def _put_part(self, imu: Table, key: str, choices: Sequence[str], words: str) -> None:
        # Accept names as printed on the board: ICM-42688-P.
        part = words if words in choices else one_of(re.sub(r"[-_ ]", "", words), choices)
        if part != imu.get("profile", UNKNOWN):
            imu["profile"] = part
        self.guessed.discard(key)

    def _put_platform(self, words: str) -> None:
        platform = PLATFORMS.get(words.strip().lower(), words)
        self._put("vehicle", "platform", one_of(platform, get_args(Platform)), "ground")

    def put_law(self, words: str) -> None:
        self._put("gradienter", "law", one_of(words, get_args(Law)))

    def put_mounting(self, kind: Kind, words: str) -> None:
        self._put(kind, "mounting", mounting_of(words), "ROTATION_NONE")

    def _put(self, name: str, key: str, value: Any, default: Any = None) -> None:
        before = copy.deepcopy(self.wanted)
        section = self.section("imu") if name == "imu" else self.wanted.get(name)
        if value != default or key in (section or {}):
            (self.wanted.setdefault(name, {}) if section is None else section)[key] = value
            self._check(before)
        self.guessed.discard(f"{name}.{key}")

    def _check(self, before: Table) -> None:
        try:
            self.parsed()
        except CompanionError as error:
            self.wanted = before
            raise ConfigError(str(error).removeprefix("answer: ")) from None


def part_key(name: str) -> str:
    return f"imu.{name}.profile"


def storage_beside(path: Path) -> Path:
    return path.absolute().with_name("companion-state")


def one_of(words: str, allowed: Sequence[str]) -> str:
    word = words.strip().lower()
    found = [word] if word in allowed else [choice for choice in allowed if word and choice.startswith(word)]
    if len(found) != 1:
        raise ConfigError(f"found {shown(words)}; allowed: {', '.join(allowed)}")
    return found[0]


def mounting_of(words: str) -> str | list[float]:
    """Return the mounting that an answer means; raise ConfigError for none."""
    name = words.strip().upper().replace(" ", "_")
    for candidate in (name, f"ROTATION_{name}"):
        if candidate in ROTATIONS_DEG:
            return candidate
    try:
        angles = [float(word) for word in re.split(r"[,\s]+", words.strip("[] "))]
    except ValueError:
        angles = []
    if len(angles) == 1:
        angles = [0.0, 0.0, angles[0]]
    if len(angles) != 3 or not all(map(math.isfinite, angles)):
        raise ConfigError(f"found {shown(words)}; allowed: an angle, ROLL PITCH YAW in degrees, or a ROTATION_...")
    named = (f"ROTATION_YAW_{angles[2] % 360:g}" if angles[2] % 360 else "ROTATION_NONE") if not any(angles[:2]) else ""
    return named if named in ROTATIONS_DEG else angles


def mounting_words(mounting: Any) -> str:
    if not isinstance(mounting, str):
        return " ".join(f"{angle:g}" for angle in mounting)
    if mounting == "ROTATION_NONE":
        return "0"
    yaw = mounting.removeprefix("ROTATION_YAW_")
    return yaw if yaw.isdigit() else mounting


def sample() -> str:
    return installing.content(installing.SAMPLE).decode()


def begin(path: Path) -> Draft:
    """Begin a draft from the configuration file, or from the sample without one; raise ConfigError if it is wrong."""
    try:
        text = read_regular(path, config.MOST_BYTES).decode()
    except FileNotFoundError:
        return Draft(sample(), is_new=True)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    if text == sample():
        return Draft(text, is_new=True)
    config.parse(text, str(path), lambda _, name: name)
    return Draft(text, is_new=False)


def is_writable(path: Path) -> bool:
    folder = path.parent
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)


def holds(path: Path, text: str) -> bool:
    try:
        return read_regular(path, config.MOST_BYTES) == text.encode()
    except OSError:
        return False


def put(path: Path, text: str) -> Path | None:
    """Write the configuration file atomically; return the path of the old file's copy, None if there is no copy."""
    # Write to the target of a symbolic link; do not replace the link.
    path = path.resolve()
    kept, mode = None, installing.MODE
    if path.exists() and not holds(path, sample()):
        mode = stat.S_IMODE(path.stat().st_mode)
        names = (path.with_name(f"{path.name}.old{number}") for number in itertools.count(1))
        kept = next(name for name in names if not name.exists())
        write_atomically(kept, path.read_bytes(), mode=mode)
    write_atomically(path, text.encode(), mode=mode, parents=True)
    return kept
