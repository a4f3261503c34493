"""A udev rule that gives a plugged-in device a name of its own, whichever order things are plugged in."""

from __future__ import annotations

import re
from collections.abc import Sequence

from companion.errors import CompanionError, ConfigError
from companion.links.serial.ports import SerialPort

FILE = "/etc/udev/rules.d/71-companion-devices.rules"
_IGNORED = 'ENV{ID_MM_DEVICE_IGNORE}="1", ENV{ID_MM_PORT_IGNORE}="1"'


def rule(name: str, device: str, ports: Sequence[SerialPort]) -> tuple[str, str]:
    """The rule that makes /dev/companion-NAME of a port, and in words by what it is recognised.

    By vendor, product and serial number; where there is no serial number, or two devices share it, by the socket that
    the device is plugged into; an on-board port by its name.

    Args:
        name: what follows /dev/companion-.
        device: the port, by any of its names.
        ports: all that there are.

    Raises:
        ConfigError: the name is not allowed.
        CompanionError: there is no such port, or nothing by which it could be recognised.
    """
    if not re.fullmatch(r"[a-z0-9][a-z0-9_-]{0,30}", name):
        raise ConfigError(f"--name: found {name!r}; allowed: small letters, digits, - and _, such as gradienter")
    port = next((port for port in ports if device in (port.device, *port.by_id, *port.by_path, *port.aliases)), None)
    if port is None:
        raise CompanionError(f"{device}: no such serial port; `companion ports` lists what is there")
    matches, words = _matches(port, ports)
    return f'SUBSYSTEM=="tty", {matches}, SYMLINK+="companion-{name}", {_IGNORED}', words


def _matches(port: SerialPort, ports: Sequence[SerialPort]) -> tuple[str, str]:
    if port.vendor_id is None or port.product_id is None:
        if port.usb_interface is not None:
            raise CompanionError(f"{port.device}: a USB device that does not say its vendor and product")
        return f'KERNEL=="{port.device.removeprefix("/dev/")}"', "its name: it is on board"
    product = f'ATTRS{{idVendor}}=="{port.vendor_id:04x}", ATTRS{{idProduct}}=="{port.product_id:04x}"'
    identity = _identity(port)
    twins = [other.device for other in ports if other.device != port.device and _identity(other) == identity]
    if port.serial_number is not None and not twins:
        # A bridge with several ports has one serial number for all.
        number = f', ENV{{ID_USB_INTERFACE_NUM}}=="{port.interface_number}"' if port.interface_number else ""
        return f'{product}, ATTRS{{serial}}=="{_pattern(port.serial_number)}"{number}', "its serial number"
    why = f"{' and '.join(twins)} has the same serial number" if port.serial_number else "it has no serial number"
    words = f"the socket it is plugged into ({why}): plug it in there again"
    if port.by_path:
        path, _, number = port.by_path[0].rpartition("/")[2].partition("-port")
        which = f', ENV{{.ID_PORT}}=="{number}"' if number else ""
        return f'ENV{{ID_PATH}}=="{_pattern(path)}"{which}, {product}', words
    if port.usb_interface is not None:
        # KERNELS and ATTRS of one rule must be of one parent: here the interface says it all.
        return f'KERNELS=="{_pattern(port.usb_interface)}"', words
    raise CompanionError(f"{port.device}: {why}, and where it is plugged in is not known (is udev running?)")


def _identity(port: SerialPort) -> tuple[object, ...]:
    return (port.vendor_id, port.product_id, port.serial_number, port.interface_number)


def _pattern(text: str) -> str:
    """What a device says of itself as udev matches it: one letter for each that would mean something to udev."""
    return re.sub(r"[^A-Za-z0-9_.:,;+-]", "?", text)
