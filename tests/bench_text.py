"""Text protocols against pynmeagps, on the same lines, in one run: how many times its frames per second we decode.

Part of `make bench`; by itself: `python -m tests.bench_text`. pynmeagps is measured both ways in which it is used: its
`NMEAReader` over a stream in memory, and `NMEAReader.parse` line by line, which leaves out the framing that ours
includes. Ours is fed what a port gives at a time: one line, or 256 bytes when somebody was busy. All rounds are
interleaved, so that a machine that is busy for a while is so for everyone.

Of most of these sentences pynmeagps knows no fields: then it splits and keeps texts, while ours gives numbers that are
checked. Where it makes nothing at all of a line, or takes it for something else, there is no ratio.
"""

from __future__ import annotations

import io
import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from pynmeagps import NMEAReader

from companion.protocols.registry import Kind
from tests.support.decoders import make_decoder
from tests.support.frames import imu_line, sentence

LINES: Final = 2000
ROUNDS: Final = 9
CHUNK: Final = 256


@dataclass(frozen=True)
class Text:
    """One kind of line; each of them differs from the last."""

    words: str
    kind: Kind
    protocol: str
    line: Callable[[int], bytes]
    comparable: bool = True
    """Whether pynmeagps takes it for a sentence of its type."""


def _ymr(n: int) -> bytes:
    mag = "-00.0049,-00.2449,+00.5397"
    return sentence(
        f"VNYMR,{n / 12:+08.3f},-007.330,+000.715,{mag},-01.258,-00.100,-09.701,-00.000018,+00.001122,{n / 1e5:+.6f}"
    )


def _xdr(n: int) -> bytes:
    return sentence(f"YXXDR,A,{n / 100:07.3f},D,N,A,-00.625,D,E,C,021.651,C,T-N0000")


TEXTS: Final = (
    Text("$--HDG", "compass", "nmea", lambda n: sentence(f"HCHDG,{n / 10:.1f},10.7,E,12.2,W")),
    Text("$--HDM", "compass", "nmea", lambda n: sentence(f"HCHDM,{n / 10:05.1f},M")),
    Text("$--HDT", "compass", "nmea", lambda n: sentence(f"HEHDT,{n / 10:.1f},T")),
    Text("$PTNTHPR", "compass", "nmea", lambda n: sentence(f"PTNTHPR,{n / 10:.1f},N,-0.{n % 10},N,{n % 30}.6,N")),
    Text("$YXXDR (jewell)", "gradienter", "jewell", _xdr),
    Text("$VNYMR", "imu", "vectornav", _ymr),
    Text("$IMU", "imu", "imu_line", lambda n: imu_line(n, 5000 * n, gyro=(n / 1e6, -0.002, 0.003))),
    Text(
        "$C (os5000)",
        "compass",
        "os5000",
        lambda n: sentence(f"C{n / 10:.1f}P0.{n % 10}R-{n % 30}.6T19.0"),
        comparable=False,
    ),
    Text(
        "$x,y,T,SN (jewell)",
        "gradienter",
        "jewell",
        lambda n: f"${n / 100:07.3f},000.023,018.910,N0000\r\n".encode(),
        comparable=False,
    ),
    Text("hmr3300", "compass", "hmr3300", lambda n: f"{n / 10:.1f}, 18.6, -0.5\r\n".encode(), comparable=False),
    Text(
        "inclinometer_xy",
        "gradienter",
        "inclinometer_xy",
        lambda n: f"X={n / 100:+07.3f}\r\nY=-00.084\r\n".encode(),
        comparable=False,
    ),
)


def _ours(text: Text, chunks: list[bytes]) -> Callable[[], object]:
    def work() -> None:
        decoder = make_decoder(text.kind, text.protocol, 1e-4)
        for chunk in chunks:
            decoder.feed(chunk, 1.0)
        assert decoder.accepted == LINES, (text.words, decoder.accepted, decoder.rejected)

    return work


def _reader(data: bytes) -> Callable[[], object]:
    def work() -> None:
        assert sum(1 for _ in NMEAReader(io.BytesIO(data))) == LINES

    return work


def _parse(lines: list[bytes]) -> Callable[[], object]:
    def work() -> None:
        for line in lines:
            NMEAReader.parse(line)

    return work


def seconds_a_line(works: list[Callable[[], object]]) -> list[float]:
    """The best of several rounds in processor time, all of them in turn."""
    best_s = [float("inf")] * len(works)
    for _, (at, work) in itertools.product(range(ROUNDS), enumerate(works)):
        start_s = time.process_time()
        work()
        best_s[at] = min(best_s[at], time.process_time() - start_s)
    return [seconds / LINES for seconds in best_s]


def against_pynmeagps() -> None:
    """Print the table."""
    print("\nframes a second as multiples of pynmeagps', same lines:")
    print(f"  {'':20} {'us a frame, in':>22} {'x NMEAReader':>18} {'x parse() alone':>18}")
    print(f"  {'':20} {'lines':>11}{'256 bytes':>11} {'lines':>9}{'256 b.':>9} {'lines':>9}{'256 b.':>9}")
    for text in TEXTS:
        lines = [text.line(n) for n in range(LINES)]
        data = b"".join(lines)
        works = [_ours(text, lines), _ours(text, [data[at : at + CHUNK] for at in range(0, len(data), CHUNK)])]
        if text.comparable:
            works += [_reader(data), _parse(lines)]
        one_s, many_s, *theirs_s = seconds_a_line(works)
        row = f"  {text.words:20} {1e6 * one_s:11.2f}{1e6 * many_s:11.2f}"
        for their_s in theirs_s:
            row += f" {their_s / one_s:9.1f}{their_s / many_s:9.1f}"
        print(row)


if __name__ == "__main__":
    against_pynmeagps()
