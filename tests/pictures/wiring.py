"""Which wire goes where: three drawings, from lists of boxes, pins and wires."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Literal
from xml.sax.saxutils import escape

PITCH, HEAD, WIDTH = 26, 52, 760
"""Between pins; above the first; of the picture, px."""
_COLOURS: Final = {"data": "#1668b0", "ground": "#222", "cable": "#777", "never": "#c62828"}
Kind = Literal["data", "ground", "cable", "never"]
_STYLE: Final = (
    "text{font:13px system-ui,'DejaVu Sans',sans-serif;fill:#1c1c1c}.h{font-weight:600}.n{fill:#555;font-size:12px}"
    ".w{fill:#c62828;font-weight:600}path{fill:none;stroke-width:2.5}.b{fill:#f3f6f9;stroke:#8896a5}"
)


@dataclass(frozen=True, slots=True)
class Box:
    """A part with its pins: those that begin with < on its left edge, else on its right one."""

    x: int
    y: int
    width: int
    title: str
    what: str
    pins: Sequence[str]

    @property
    def height(self) -> int:
        """Of the whole box, px."""
        return HEAD + PITCH * max(len(self.pins), 1)

    def place(self, pin: str) -> tuple[int, int]:
        """Where a wire ends, px."""
        index = next(number for number, name in enumerate(self.pins) if name.lstrip("<") == pin)
        is_left = self.pins[index].startswith("<")
        return (self.x if is_left else self.x + self.width), self.y + HEAD + PITCH * index + 4

    def svg(self) -> Iterator[str]:
        """As it is drawn."""
        yield f'<rect class="b" x="{self.x}" y="{self.y}" width="{self.width}" height="{self.height}" rx="6"/>'
        yield f'<text class="h" x="{self.x + 10}" y="{self.y + 20}">{escape(self.title)}</text>'
        yield f'<text class="n" x="{self.x + 10}" y="{self.y + 37}">{escape(self.what)}</text>'
        for pin in self.pins:
            x, y = self.place(pin.lstrip("<"))
            inward, anchor = (10, "start") if pin.startswith("<") else (-10, "end")
            yield f'<circle cx="{x}" cy="{y}" r="4" fill="#8896a5"/>'
            yield f'<text x="{x + inward}" y="{y + 4}" text-anchor="{anchor}">{escape(pin.lstrip("<"))}</text>'


@dataclass(frozen=True, slots=True)
class Wire:
    """From a pin of one box to a pin of another; `never` is crossed out, and leads nowhere."""

    begin: tuple[Box, str]
    end: tuple[Box, str] | None
    kind: Kind
    words: str = ""

    def svg(self) -> Iterator[str]:
        """As it is drawn."""
        x, y = self.begin[0].place(self.begin[1])
        colour = _COLOURS[self.kind]
        if self.end is None:
            yield f'<path d="M{x} {y}h22m-7 -7l14 14m0 -14l-14 14" stroke="{colour}"/>'
            yield f'<text class="w" x="{x + 38}" y="{y + 4}">{escape(self.words)}</text>'
            return
        to_x, to_y = self.end[0].place(self.end[1])
        middle = (x + to_x) // 2
        yield f'<path d="M{x} {y}C{middle} {y} {middle} {to_y} {to_x} {to_y}" stroke="{colour}"/>'
        if self.words:
            text_y = (y + to_y) // 2 - 7
            yield f'<text class="n" x="{middle}" y="{text_y}" text-anchor="middle">{escape(self.words)}</text>'


def drawing(title: str, boxes: Sequence[Box], wires: Sequence[Wire], notes: Sequence[str], warning: str = "") -> str:
    """The picture; below it a warning in red, and notes."""
    bottom = max(box.y + box.height for box in boxes)
    below = [("w", warning)] * bool(warning) + [("n", note) for note in notes]
    parts = [line for wire in wires for line in wire.svg()] + [line for box in boxes for line in box.svg()]
    for number, (style, words) in enumerate(below, 1):
        parts.append(f'<text class="{style}" x="20" y="{bottom + 6 + 20 * number}">{escape(words)}</text>')
    size = f"0 0 {WIDTH} {bottom + 14 + 20 * len(below)}"
    inner = "\n".join(parts)
    return f"""<svg xmlns="http://www.w3.org/2000/svg" viewBox="{size}" role="img" aria-label="{escape(title)}">
<style>{_STYLE}</style>
<rect width="100%" height="100%" fill="#fff"/>
{inner}
</svg>
"""


def uart() -> str:
    """TELEM 2 (Pixhawk connector standard, DS-009) to the 40 pins of a Raspberry Pi."""
    autopilot = Box(
        20,
        20,
        220,
        "Flight controller",
        "TELEM 2, six pins",
        ("1: 5 V", "2: TX", "3: RX", "4: CTS", "5: RTS", "6: GND"),
    )
    board = Box(510, 46, 230, "Raspberry Pi", "40 pins; /dev/serial0", ("<pin 10: RXD", "<pin 8: TXD", "<pin 6: GND"))
    return drawing(
        "The autopilot on the UART of a Raspberry Pi",
        (autopilot, board),
        (
            Wire((autopilot, "1: 5 V"), None, "never", "leave open"),
            Wire((autopilot, "2: TX"), (board, "pin 10: RXD"), "data"),
            Wire((autopilot, "3: RX"), (board, "pin 8: TXD"), "data"),
            Wire((autopilot, "6: GND"), (board, "pin 6: GND"), "ground"),
        ),
        (
            "Crossed: what one sends, the other receives. Both are 3.3 V; the board has its own supply.",
            "raspi-config, Interface Options, Serial Port: login shell no, hardware yes; then a restart.",
        ),
    )


def usb() -> str:
    """What has a USB plug, and 5 V logic behind an adapter."""
    autopilot = Box(20, 20, 200, "Flight controller", "its USB socket", ("USB",))
    imu = Box(20, 118, 200, "IMU of your own", "with USB, if you have one", ("USB",))
    compass = Box(20, 216, 200, "Compass", "5 V logic (HMR3300)", ("TX", "RX", "GND"))
    adapter = Box(330, 216, 180, "USB adapter", "made for 5 V logic", ("<RX", "<TX", "<GND", "USB"))
    board = Box(
        590, 20, 150, "Companion", "any Linux board", ("<USB 1", "<USB 2", "<USB 3"),
    )  # fmt: skip
    return drawing(
        "By USB",
        (autopilot, imu, compass, adapter, board),
        (
            Wire((autopilot, "USB"), (board, "USB 1"), "cable", "nothing to set: /dev/ttyACM0"),
            Wire((imu, "USB"), (board, "USB 2"), "cable"),
            Wire((compass, "TX"), (adapter, "RX"), "data"),
            Wire((compass, "RX"), (adapter, "TX"), "data"),
            Wire((compass, "GND"), (adapter, "GND"), "ground"),
            Wire((adapter, "USB"), (board, "USB 3"), "cable"),
        ),
        (
            "Supply of the compass by its data sheet.",
            "companion ports lists names that stay, whatever is plugged in first.",
        ),
        "5 V destroys the board's own pins: only through the adapter, or a level shifter.",
    )


def rs232() -> str:
    """A sensor with RS-232 levels behind an adapter with a DE-9 plug."""
    gradienter = Box(20, 20, 200, "Gradienter", "RS-232, ±12 V", ("TX", "RX", "GND"))
    adapter = Box(
        310, 20, 210, "USB to RS-232 adapter", "nine pins", ("<2: receives", "<3: sends", "<5: GND", "USB"),
    )  # fmt: skip
    board = Box(600, 72, 140, "Companion", "any Linux board", ("<USB",))
    return drawing(
        "A gradienter with RS-232",
        (gradienter, adapter, board),
        (
            Wire((gradienter, "TX"), (adapter, "2: receives"), "data"),
            Wire((gradienter, "RX"), (adapter, "3: sends"), "data"),
            Wire((gradienter, "GND"), (adapter, "5: GND"), "ground"),
            Wire((adapter, "USB"), (board, "USB"), "cable"),
        ),
        ("Silent? Exchange 2 and 3. Supply of the gradienter by its data sheet; its minus is GND.",),
        "Never to a board's own pins: ±12 V destroy them.",
    )


DRAWINGS: Final = {"uart": uart, "usb": usb, "rs232": rs232}
