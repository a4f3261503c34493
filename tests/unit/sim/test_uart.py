"""A line read at another setting than it was sent: facts that are known of every UART."""

from __future__ import annotations

import pytest

from sim.pty_device import Setting, heard, receive, transmit

SLOW = Setting(4800)
USUAL = Setting(9600)
FAST = Setting(19200)
EVEN = Setting(9600, "even")
ODD = Setting(9600, "odd")


@pytest.mark.parametrize("setting", [USUAL, EVEN, ODD, Setting(115200, "odd")])
@pytest.mark.parametrize("gap", [0, 1, 7])
def test_every_byte_arrives_where_both_ends_agree(setting: Setting, gap: int) -> None:
    data = bytes(range(256))
    frames = list(receive(transmit(data, setting, gap), setting.baud, setting))
    assert bytes(frame.byte for frame in frames) == data
    assert not any(frame.framing_error or frame.parity_error for frame in frames)


def test_0x55_at_half_the_speed() -> None:
    # U on the wire is 0 1 0 1 0 1 0 1 0 1: a square wave. Read twice as fast it is 0 0 1 1 0 0 1 1 0 0: a start bit,
    # the data 0 1 1 0 0 1 1 0, and a low in the place of the stop bit.
    first = next(receive(transmit(b"U", SLOW), SLOW.baud, USUAL))
    assert first.byte == 0x66
    assert first.framing_error


def test_8e1_read_as_8n1_spoils_exactly_the_bytes_with_an_even_number_of_ones_where_there_are_pauses() -> None:
    # The parity bit stands where the stop bit is looked for: 1 passes for it, 0 is an error. The byte is right.
    for byte in range(256):
        first = next(receive(transmit(bytes([byte]), EVEN), EVEN.baud, USUAL))
        assert first.byte == byte
        assert first.framing_error == (byte.bit_count() % 2 == 0)


def test_8n1_read_as_8e1_fails_the_parity_of_bytes_with_an_even_number_of_ones() -> None:
    # The stop bit, 1, stands where the parity bit is looked for; the idle line is the stop bit.
    for byte in range(256):
        first = next(receive(transmit(bytes([byte]), USUAL), USUAL.baud, EVEN))
        assert first.byte == byte
        assert first.parity_error == (byte.bit_count() % 2 == 0)
        assert not first.framing_error
        assert heard(bytes([byte]), USUAL, EVEN) == (b"\0" if first.parity_error else bytes([byte]))


def test_at_the_wrong_speed_next_to_nothing_of_a_text_is_left() -> None:
    text = b"X=+00.430\r\nY=-00.084\r\n" * 20
    for baud in (1200, 2400, 4800, 19200, 38400, 57600, 115200):
        assert b"X=+00" not in heard(text, USUAL, Setting(baud))
    # A few per cent off is what every crystal may be.
    assert heard(text, USUAL, Setting(9700)) == text
    assert heard(text, USUAL, Setting(8800)) != text
