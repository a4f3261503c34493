"""Errors: one class for each kind of cause, all below `CompanionError`. Interfaces show an error as one line.

The text of an error is for a tired pilot: it names the place, the value found, and the allowed values.
"""

from __future__ import annotations


class CompanionError(Exception):
    """Base class of all errors that the companion raises on purpose."""


class ConfigError(CompanionError):
    """The configuration cannot be used; the text is one line with file, key, value found and values allowed."""


class LinkError(CompanionError):
    """A port, socket or stream could not be opened or was lost."""


class DaemonUnreachableError(CompanionError):
    """No daemon answers on the control socket."""


class DaemonDeniedError(DaemonUnreachableError):
    """The daemon runs, but this user may not use its control socket."""


class NobodyHeardError(CompanionError):
    """A ground command receives nothing from the vehicle, or nothing from the companion, on the telemetry link."""


class StorageError(CompanionError):
    """A stored file, such as a record or a profile, cannot be written or read."""


class CalibrationRefusedError(CompanionError):
    """A measurement failed its own checks, or a request is not allowed; nothing may be written to the autopilot."""


class RequestRefusedError(CalibrationRefusedError):
    """A request was refused; `kind` is the reason as a key word of docs/mqtt.md, such as armed, busy or moving."""

    def __init__(self, kind: str, reason: str) -> None:
        super().__init__(reason)
        self.kind = kind


class AutopilotError(CompanionError):
    """The autopilot did not do what the companion requested."""


class NotDisarmedError(AutopilotError):
    """The autopilot is armed, or its armed state is unknown: nothing may be written to it."""


class ParameterTimeoutError(AutopilotError):
    """The autopilot did not answer a parameter request within all retries."""


class ParameterRefusedError(AutopilotError):
    """The autopilot refused to set a parameter (PARAM_ERROR), or confirmed another value than the requested one."""


class ParameterMismatchError(ParameterRefusedError):
    """The autopilot confirmed the write of a parameter, but with another value than the requested one."""


class AutopilotRebootedError(AutopilotError):
    """The autopilot restarted while the companion was waiting for its answers."""
