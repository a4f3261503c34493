"""Errors, one class for each kind of cause, with one root class: an interface catches that and shows one line.

The text of an error is for a tired pilot: the place, the value found, and the values allowed.
"""

from __future__ import annotations


class CompanionError(Exception):
    """Root of all errors that the companion raises on purpose."""


class ConfigError(CompanionError):
    """The configuration cannot be used; the text is one line with file, key, value found and values allowed."""


class LinkError(CompanionError):
    """A port, socket or stream could not be opened or was lost."""


class DaemonUnreachableError(CompanionError):
    """No daemon answers on the control socket."""


class DaemonDeniedError(DaemonUnreachableError):
    """A daemon is there, but this user may not use its control socket."""


class NobodyHeardError(CompanionError):
    """No vehicle, or no companion, answers on a ground station's link."""


class StorageError(CompanionError):
    """A record could not be written or read."""


class CalibrationRefusedError(CompanionError):
    """The measurement fails its own checks; nothing may be written."""


class RequestRefusedError(CalibrationRefusedError):
    """A request was not started; `kind` is the reason in one word, as in docs/mqtt.md (armed, busy, moving, ...)."""

    def __init__(self, kind: str, reason: str) -> None:
        super().__init__(reason)
        self.kind = kind


class AutopilotError(CompanionError):
    """The autopilot did not do what was asked."""


class NotDisarmedError(AutopilotError):
    """The autopilot is armed, or whether it is armed is unknown: nothing may be written."""


class ParameterTimeoutError(AutopilotError):
    """The autopilot did not answer a parameter request within all retries."""


class ParameterRefusedError(AutopilotError):
    """The autopilot refused a parameter (PARAM_ERROR) or answered with another value than was set."""


class ParameterMismatchError(ParameterRefusedError):
    """The autopilot answered a write with another value than was set."""


class AutopilotRebootedError(AutopilotError):
    """The autopilot restarted in the middle of an exchange."""
