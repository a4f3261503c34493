"""The page as one document: its parts are files that an editor knows, what a browser gets is one answer.

So a phone at the edge of the hotspot has all of it or nothing, and the policy names what may run in it by digest.
"""

from __future__ import annotations

import base64
import hashlib
import re
from pathlib import Path
from typing import Final

PARTS: Final = Path(__file__).with_name("page")
_STYLE: Final = re.compile(rb'<link rel="stylesheet" href="([\w./]+)">')
_SCRIPT: Final = re.compile(rb'<script src="([\w.]+)"></script>')


def assembled() -> bytes:
    """The page with its styles and scripts in it."""
    html = (PARTS / "page.html").read_bytes()
    html = _STYLE.sub(lambda found: b"<style>\n" + _part(found[1]) + b"</style>", html)
    return _SCRIPT.sub(lambda found: b"<script>\n" + _part(found[1]) + b"</script>", html)


def security_headers(html: bytes) -> tuple[tuple[str, str], ...]:
    """Nothing but the page's own style and script runs in it, and it speaks to nobody but us."""

    def hashes(tag: bytes) -> str:
        found = re.findall(b"<" + tag + b">(.*?)</" + tag + b">", html, re.DOTALL)
        digests = (base64.b64encode(hashlib.sha256(text).digest()).decode() for text in found)
        return " ".join(f"'sha256-{digest}'" for digest in digests)

    policy = (
        f"default-src 'none'; script-src {hashes(b'script')}; style-src {hashes(b'style')}; connect-src 'self'; "
        "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return (
        ("Content-Security-Policy", policy),
        ("X-Content-Type-Options", "nosniff"),
        ("X-Frame-Options", "DENY"),
        ("Referrer-Policy", "no-referrer"),
        ("Cross-Origin-Resource-Policy", "same-origin"),
        ("Cross-Origin-Opener-Policy", "same-origin"),
        ("Cache-Control", "no-store"),
    )


def _part(name: bytes) -> bytes:
    return (PARTS / name.decode("ascii")).read_bytes()
