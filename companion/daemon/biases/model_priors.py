"""What a fleet tells of the models of the IMUs that there are: kept on disk, as there is no network in the field."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

import msgspec

from companion.calibration.solution.model_prior import FORMAT_VERSION, ModelPrior, TriadPrior, check, read
from companion.calibration.solution.prior import CONTRADICTS, Expected
from companion.formats import Object
from companion.samples import TRIADS, Triad
from companion.storage.state import StateFile

logger = logging.getLogger(__name__)

TOPIC: Final = "fleet/priors/"
"""And the model."""


class _File(msgspec.Struct, frozen=True, kw_only=True):
    models: dict[str, ModelPrior]
    format_version: int = FORMAT_VERSION


def _check(found: _File) -> None:
    for prior in found.models.values():
        check(prior)


class ModelPriors:
    """Taken from the fleet, and asked for by IMU."""

    def __init__(self, directory: Path, models: Callable[[], Mapping[str, str]]) -> None:
        path = directory / "model-priors.json"
        self._file: StateFile[_File] = StateFile(path, _File, _check, FORMAT_VERSION)
        self._models = models
        self._known: dict[str, ModelPrior] = {}
        self._refused: dict[str, str] = {}
        self._judged: dict[tuple[str, Triad], Expected | None] = {}

    def load(self) -> None:
        """Read what was kept before this start; blocking."""
        found = self._file.load()
        self._known = {} if found is None else found.models

    @property
    def topics(self) -> list[str]:
        """Where the fleet tells of these models."""
        return [f"{TOPIC}{model}" for model in sorted(set(self._models().values()))]

    def take(self, topic: str, payload: bytes) -> None:
        """Keep what was told, and refuse what cannot be; blocking. Nothing at all withdraws what was told before.

        Raises:
            StorageError: it cannot be kept; it counts until the end of this run.
        """
        model = topic.removeprefix(TOPIC)
        if model not in self._models().values():
            return
        known = {key: value for key, value in self._known.items() if key != model}
        if payload:
            try:
                known[model] = read(payload, model)
            except ValueError as error:
                words = f"{topic}: not taken: {error}"
                if self._refused.get(model) != words:
                    logger.warning("%s", words)
                self._refused[model] = words
                return
        self._refused.pop(model, None)
        if known != self._known:
            self._known = known
            self._file.write(_File(models=self._known))

    def of(self, name: str, triad: Triad) -> TriadPrior | None:
        """What is known of the model of an IMU; None: nothing."""
        known = self._known.get(self._models().get(name, ""))
        return None if known is None else known.of(triad)

    def judged(self, name: str, triad: Triad, expected: Expected | None) -> None:
        """What became of it beside the IMU's own power-ups."""
        self._judged[name, triad] = expected

    def status(self) -> list[Object]:
        """For `companion status`, by IMU."""
        return [
            {"imu": name, "model": model, "summary": self._in_words(name, model)}
            for name, model in sorted(self._models().items())
        ]

    def _in_words(self, name: str, model: str) -> str:
        known = self._known.get(model)
        if known is None:
            return self._refused.get(model) or f"imu {name}: the fleet has told nothing of its model ({model}) yet"
        words = ", ".join(f"{triad} {self._verdict(name, triad)}" for triad in TRIADS if known.of(triad) is not None)
        line = f"imu {name}: model {model} of the fleet ({known.parts} parts): {words}"
        return f"{line}; {self._refused[model]}" if model in self._refused else line

    def _verdict(self, name: str, triad: Triad) -> str:
        expected = self._judged.get((name, triad))
        if expected is None or expected.of_model is None:
            return "not judged yet"
        if expected.by_model:
            return "takes part"
        if abs(expected.of_model) <= CONTRADICTS:
            return "not needed, its own power-ups tell more"
        return f"not used, its own power-ups scatter {'more' if expected.of_model > 0.0 else 'less'} than that"
