"""The alignment in force: the gradienter's measured zero, and whether it still belongs to this configuration."""

from __future__ import annotations

import logging

import msgspec

from companion.config.sections import Config
from companion.configured import models
from companion.daemon.core import Offload
from companion.estimation.means.pose import GradienterModel
from companion.estimation.records.align_record import AlignmentRecord, GradienterSettings
from companion.estimation.records.record import AlignmentUsed
from companion.links.system.listeners import Listeners
from companion.storage.learned import alignment_in

logger = logging.getLogger(__name__)


class AlignmentInForce:
    """Keeps the alignment on disk, and gives the gradienter's model with it."""

    def __init__(self, config: Config, offload: Offload) -> None:
        self._gradienter, self._offload = config.gradienter, offload
        self._store = alignment_in(config.storage.path)
        self.record: AlignmentRecord | None = None
        """What is kept, whether or not it is used."""
        self.unused: str | None = None
        """Why what is kept is not used, in one line; None while it is used, or nothing is kept."""
        self.on_change: Listeners[[]] = Listeners()
        """Told when another zero is in force."""

    def load(self) -> None:
        """Read what was kept before this start; blocking. What cannot be used is set aside and said."""
        self._take(self._store.load())
        if self._store.unusable is not None:
            self.unused = self._store.unusable
        elif self.unused is not None:
            logger.warning("alignment not used: %s", self.unused)

    async def keep(self, record: AlignmentRecord) -> None:
        """Put a new alignment in force, now and after every restart.

        Raises:
            StorageError: it could not be kept; the one before stays in force.
        """
        await self._offload(self._store.write, record)
        self._take(record)
        self.on_change.tell()

    async def forget(self) -> bool:
        """Go back to what the configuration says; whether there was anything to forget.

        Raises:
            StorageError: the file could not be removed.
        """
        was = self.record is not None or self.unused is not None
        await self._offload(self._store.clear)
        self._take(None)
        if was:
            self.on_change.tell()
        return was

    def settings(self) -> GradienterSettings | None:
        """What an alignment belongs to; None without a gradienter."""
        if self._gradienter is None:
            return None
        return msgspec.convert(self._gradienter, GradienterSettings, from_attributes=True)

    @property
    def used(self) -> AlignmentUsed | None:
        """For the record of a calibration: what of it is in force; None where nothing is."""
        if self.record is None or self.unused is not None:
            return None
        return msgspec.convert(self.record, AlignmentUsed, from_attributes=True)

    def model(self) -> GradienterModel | None:
        """The gradienter's model as it is in force."""
        return models.aligned(models.gradienter_model(self._gradienter), self.used)

    def status(self) -> dict[str, object] | None:
        """For `companion status`; None where nothing is kept."""
        if self.record is None and self.unused is None:
            return None
        kept = {key: getattr(self.record, key, None) for key in ("kind", "measured_at", "offset_deg", "sigma_deg")}
        return {"in_force": self.used is not None, "unused_because": self.unused, **kept}

    def _take(self, record: AlignmentRecord | None) -> None:
        self.record, self.unused = record, None
        now = self.settings()
        if record is None:
            return
        if now is None:
            self.unused = "no gradienter is configured"
            return
        different = [key for key in now.__struct_fields__ if getattr(record.gradienter, key) != getattr(now, key)]
        if different:
            names = ", ".join(f"gradienter.{key}" for key in different)
            self.unused = f"measured with another {names}: companion align zero, or companion align --forget"
