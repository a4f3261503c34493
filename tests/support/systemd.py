"""Where systemd's tools are, for tests that ask them."""

from __future__ import annotations

import shutil

import pytest

SYSTEMD_ANALYZE = shutil.which("systemd-analyze") or ""
needs_systemd_analyze = pytest.mark.skipif(
    not SYSTEMD_ANALYZE, reason="systemd-analyze is not here (Debian: apt-get install systemd)"
)
