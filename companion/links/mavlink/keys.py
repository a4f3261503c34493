"""The file with the key for MAVLink 2 signing.

32 bytes as they are, 64 hexadecimal digits, or a passphrase. Of a passphrase the key is SHA-256 of its UTF-8, as
MAVProxy 1.8.75 (`passphrase_to_key`), Mission Planner (`MAVAuthKeys.AddKey`) and QGroundControl until early 2026
(`MAVLinkSigningKeys::addKey`) make it; later QGroundControls use PBKDF2, and take the 64 digits as a raw key.
"""

from __future__ import annotations

import hashlib
import os
import re
import stat
from pathlib import Path
from typing import Final

from companion.errors import LinkError

KEY_BYTES: Final = 32
LEAST_PASSPHRASE: Final = 8
MAX_FILE_BYTES: Final = 1024
_HEX: Final = re.compile(rb"[0-9a-fA-F]{64}")
_WANTED: Final = (
    f"32 bytes, 64 hexadecimal digits, or a passphrase of {LEAST_PASSPHRASE} characters or more on one line"
)


def read_key(path: Path) -> bytes:
    """The 32 bytes of the key.

    Raises:
        LinkError: one line that names the file and what is wrong with it, and nothing of what is in it.
    """
    try:
        with path.open("rb") as file:
            rights = os.fstat(file.fileno()).st_mode
            content = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise LinkError(f"signing key file {path}: {error.strerror or type(error).__name__}") from None
    if rights & (stat.S_IROTH | stat.S_IWOTH):
        raise LinkError(f"signing key file {path}: everybody on this computer may open it: chmod 600 {path}")
    is_raw = len(content) == KEY_BYTES and not _is_text(content)
    key = content if is_raw else _from_text(content, path)
    if not any(key):
        # All zero means "no signing" in SETUP_SIGNING.
        raise LinkError(f"signing key file {path}: a key of zeros is none")
    return key


def _is_text(content: bytes) -> bool:
    """Whether this could have been typed; 32 random bytes are so once in 10^13."""
    return all(32 <= byte < 127 or byte in b"\r\n" for byte in content)


def _from_text(content: bytes, path: Path) -> bytes:
    line = content.removesuffix(b"\n").removesuffix(b"\r")
    if _HEX.fullmatch(line):
        return bytes.fromhex(line.decode("ascii"))
    try:
        passphrase = line.decode()
    except UnicodeDecodeError:
        passphrase = ""
    if len(content) > MAX_FILE_BYTES or len(passphrase) < LEAST_PASSPHRASE or not passphrase.isprintable():
        raise LinkError(f"signing key file {path}: found {len(content)} bytes; wanted: {_WANTED}")
    return hashlib.sha256(line).digest()
