"""Table of commands: one class per command, with the type, limits and help of each field and who may set it.

Command line options and the requests over control socket, MQTT and web page are derived from this table. The MAVLink
component converts the parameters of its commands to the same fields. A new command needs a class and a place in `ALL`.
"""

from __future__ import annotations

import enum
import functools
import typing
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Final, Literal, NamedTuple, Self

import msgspec

from companion.errors import CalibrationRefusedError
from companion.estimation.machine import LONGEST_S, What
from companion.formats import Object, printable

MAX_SHOWN: Final = 60  # Maximum number of characters of a value in an error text


class Interface(enum.Flag):
    """Interfaces through which a command can reach the daemon; its control socket itself accepts every command."""

    COMMAND_LINE = enum.auto()
    GROUND = enum.auto()  # `companion ground` over MAVLink
    MQTT = enum.auto()
    PAGE = enum.auto()


_SHELL: Final = Interface.COMMAND_LINE
_SHELLS: Final = Interface.COMMAND_LINE | Interface.GROUND
_ALL: Final = _SHELLS | Interface.MQTT | Interface.PAGE


class Field(NamedTuple):
    """Description of one field of a command; `type` comes from the annotation of the field."""

    help: str = ""
    by: Interface = _SHELL  # The interfaces that may set the field
    metavar: str | None = None
    allowed_words: str = ""
    """Description of the allowed values, for a type that does not list them."""
    flags: Mapping[str, str] = {}
    """Values of a field that have their own command line option, such as --gyros, each with its help text."""
    positional: bool = False  # True: on the command line, values that are not in `flags` are positional
    short: str = ""
    default: Any = None  # Value used by the command line if none is given
    group: str = ""  # Options of the same group exclude each other
    type: Any = None

    @property
    def values(self) -> tuple[Any, ...]:
        kinds = (self.type, *typing.get_args(self.type))
        return next((typing.get_args(kind) for kind in kinds if typing.get_origin(kind) is Literal), ())

    @property
    def kind(self) -> type:
        if self.values:
            return type(self.values[0])
        kind = next((each for each in typing.get_args(self.type) if each is not type(None)), self.type)
        return typing.get_args(kind)[0] if typing.get_origin(kind) is Annotated else kind

    @property
    def allowed(self) -> str:
        """Description of the field's allowed values: `allowed_words`, otherwise derived from the type."""
        if self.type is bool:
            return "true or false"
        return self.allowed_words or ", ".join(map(shown, self.values))


class Command(msgspec.Struct, frozen=True, kw_only=True, tag_field="command"):
    """Base class of all commands to the daemon; the `tag` of a subclass is the name of its command."""

    help: ClassVar[str] = ""
    by: ClassVar[Interface] = _SHELL  # The interfaces that may send the command
    urgent: ClassVar[bool] = False
    """True: the control socket reserves connections for this command, so that others cannot block it."""

    @classmethod
    def name(cls) -> str:
        return str(cls.__struct_config__.tag)

    @classmethod
    def fields(cls, by: Interface | None = None) -> dict[str, Field]:
        fields = _fields(cls)
        return {name: field for name, field in fields.items() if by is None or by in field.by}

    @classmethod
    def read(cls, request: Object) -> Self:
        """Parse the fields of a request; ignore unknown keys and keys whose value is null.

        Raises:
            CalibrationRefusedError: a value is not allowed.
        """
        values = {}
        for name, field in cls.fields().items():
            if (value := request.get(name)) is None:
                continue
            try:
                values[name] = msgspec.convert(value, field.type)
            except (msgspec.ValidationError, OverflowError):
                reason = f"{name!r}: found {shown(value)}; allowed: {field.allowed}"
                raise CalibrationRefusedError(reason) from None
        return cls(**values)


@functools.cache
def _fields(kind: type[Command]) -> dict[str, Field]:
    hints = typing.get_type_hints(kind, include_extras=True)
    found = {}
    for name in kind.__struct_fields__:
        inner, *notes = typing.get_args(hints[name])
        found[name] = next(note for note in notes if isinstance(note, Field))._replace(type=inner)
    return found


def shown(value: object) -> str:
    try:
        text = msgspec.json.encode(value).decode()
    except (OverflowError, RecursionError):
        return "what is too large"
    text = printable(text)
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}..."


_Seconds = Annotated[float, msgspec.Meta(gt=0.0, lt=LONGEST_S)]
_SECONDS: Final = Field(metavar="S", allowed_words="a number of seconds above 0")
_Count = Annotated[int, msgspec.Meta(ge=1, le=10**6)]


class Status(Command, frozen=True, tag="status"):
    help = "what the daemon is doing"
    urgent = True


class Monitor(Command, frozen=True, tag="monitor"):
    help = "watch the daemon until Ctrl-C"
    pose: Annotated[bool, Field("attitude, and records as they end, too", by=Interface.MQTT)] = False
    samples: Annotated[bool, Field("with `pose`: mean readings of the autopilot's IMUs, too", by=Interface(0))] = False


class Calibrate(Command, frozen=True, tag="calibrate"):
    help = "calibrate now (the aircraft must be disarmed and still)"
    by = _ALL
    what: Annotated[
        Literal["both", "gyros", "accelerometers"],
        Field(by=_ALL, flags={"gyros": "gyros only", "accelerometers": "accelerometers only"}),
    ] = "both"
    wait: Annotated[bool, Field(by=Interface(0))] = False
    timeout_s: Annotated[
        _Seconds | None,
        _SECONDS._replace(
            help="cancel when it has not finished by then (default: no limit)", by=_SHELLS | Interface.MQTT
        ),
    ] = None
    reboot: Annotated[
        bool, Field("restart the autopilot afterwards (PX4's attitude needs it)", by=_SHELLS | Interface.MQTT)
    ] = False

    @classmethod
    def of(cls, what: What, *, reboot: bool = False) -> Self:
        return cls.read({"what": what.name.lower(), "reboot": reboot})

    @property
    def biases(self) -> What:
        return What[self.what.upper()]


class Align(Command, frozen=True, tag="align"):
    help = "measure the gradienter's zero, or accelerometers and compasses by hand"
    by = _SHELL | Interface.PAGE
    action: Annotated[
        Literal["zero", "tilts", "turn", "faces", "compass", "show", "forget"] | None,
        Field(by=by),
    ] = None
    headings: Annotated[
        Literal[1, 2, 3, 4, 6, 8] | None,
        Field(
            "2 (default for zero): turn by 180 deg, then the same way to the start; 4 (default for turn and compass):"
            " every 90 deg; compass also: 3, 6, 8, and 1 with --heading or a compass of the companion",
            by=by,
        ),
    ] = None
    heading: Annotated[
        Annotated[float, msgspec.Meta(ge=0.0, le=360.0)] | None,
        Field(
            "true heading of the first pose, if a line on the ground tells it to 2 deg",
            by=by,
            metavar="DEG",
            allowed_words="a number from 0 to 360",
        ),
    ] = None
    sides: Annotated[bool, Field("after faces: the compasses on six sides, at any heading", by=by)] = False
    level: Annotated[bool, Field("after faces: write the tilt of the board (AHRS_TRIM, SENS_BOARD)", by=by)] = False
    write: Annotated[bool, Field("write the result to the autopilot", by=by)] = False
    wait: Annotated[bool, Field(by=Interface(0))] = True
    timeout_s: Annotated[_Seconds | None, _SECONDS._replace(help="give up this time after a pose (default 900)")] = None


class Cancel(Command, frozen=True, tag="cancel"):
    help = "cancel a running calibration"
    by = _ALL
    urgent = True


class Undo(Command, frozen=True, tag="undo"):
    help = "restore the autopilot's values from before the last write"
    by = _ALL
    force: Annotated[
        bool,
        Field(
            "keep values that another program changed; restore the others",
            by=_SHELL | Interface.MQTT | Interface.PAGE,
        ),
    ] = False


class Fix(Command, frozen=True, tag="fix"):
    help = "carry out the first remedy that `companion status` names"
    by = _SHELL | Interface.PAGE


class AutopilotSetup(Command, frozen=True, tag="autopilot-setup"):
    help = "parameters that the autopilot needs for the gate, the offsets and the heading"


class History(Command, frozen=True, tag="history"):
    help = "list past calibrations"
    limit: Annotated[
        _Count | None,
        Field(
            "the latest N (default 20)",
            metavar="N",
            short="-n",
            default=20,
            allowed_words="a whole number from 1 to 1000000",
        ),
    ] = None


class Temperature(Command, frozen=True, tag="temperature"):
    help = "gyro biases over temperature, as measured so far"
    action: Annotated[
        Literal["write", "undo"] | None,
        Field(
            flags={
                "write": "write the curves into the autopilot (disarmed and still)",
                "undo": "restore the values from before the curves",
            },
            group="action",
        ),
    ] = None
    overwrite: Annotated[
        bool,
        Field("as --write, also over a temperature calibration that is not the companion's", group="action"),
    ] = False


class RecordInputs(Command, frozen=True, tag="record"):
    help = "record all inputs to a file until Ctrl-C (the last hour is kept anyway)"
    file: Annotated[
        str | None,
        Field("default: one beside the daemon's own", metavar="FILE", positional=True, allowed_words="a path"),
    ] = None
    seconds: Annotated[_Seconds | None, _SECONDS._replace(help="default: until Ctrl-C, --stop or 1 GB")] = None
    stop: Annotated[bool, Field("end a recording that runs")] = False


class Answer(Command, frozen=True, tag="answer"):
    """Answer of the operator to a question of the first-run set-up, which runs before there is a daemon."""

    by = Interface.PAGE
    number: Annotated[int | None, Field(by=by, allowed_words="a whole number")] = None
    words: Annotated[str | None, Field(by=by, allowed_words="a text")] = None


ALL: Final = {
    kind.name(): kind
    for kind in (
        Status, Calibrate, Align, Cancel, Undo, Fix, AutopilotSetup, History, Temperature, Monitor, RecordInputs, Answer
    )
}  # fmt: skip
"""Class of each command, by the name of the command."""


def commands_for(interface: Interface) -> dict[str, type[Command]]:
    return {name: kind for name, kind in ALL.items() if interface in kind.by}
