"""Biases from a window: the window's means, the site, gradienter and compass, and the stand-ins for missing sensors."""

from __future__ import annotations

from typing import NamedTuple

from companion.autopilot.vehicle.ekf import OwnAttitude
from companion.configured import models
from companion.daemon.core import Core
from companion.daemon.stands.alignment import AlignmentInForce, FacesInForce
from companion.errors import AutopilotError
from companion.estimation.means.windows import Window
from companion.estimation.request import What
from companion.estimation.solution.site import Whereabouts, local_earth
from companion.estimation.solution.solve import Solution, solve
from companion.estimation.solution.truth import NOTHING, Otherwise, OwnHeading


class EstimatorInputs(NamedTuple):
    """Inputs of an estimate besides the window."""

    where: Whereabouts
    otherwise: Otherwise


class Estimator:
    """Estimates biases with the alignment and the site in force."""

    def __init__(self, core: Core, alignment: AlignmentInForce, faces: FacesInForce, own: OwnAttitude) -> None:
        self._core, self.alignment, self._faces, self._own = core, alignment, faces, own

    async def solve(self, window: Window, what: What) -> tuple[Solution, EstimatorInputs]:
        """Estimate the biases; returns the other inputs too.

        Raises:
            CalibrationRefusedError: as `solve`.
        """
        config = self._core.config
        given = EstimatorInputs(models.whereabouts(config, self._core.vehicle), await self._otherwise(window))
        poses = self.alignment.model(), models.compass_model(config.compass)
        platform, any_bias = config.vehicle.platform, config.calibration.any_bias
        found: Solution = await self._core.offload(
            lambda: solve(
                window, local_earth(given.where), *poses, what, platform, any_bias=any_bias, otherwise=given.otherwise
            )
        )
        return found, given

    async def _otherwise(self, window: Window) -> Otherwise:
        config = self._core.config
        if config.gradienter is not None and config.compass is not None:
            return NOTHING
        return Otherwise(
            sides=self._faces.sides(window) if config.gradienter is None else {},
            heading=await self._own_heading() if config.compass is None else None,
        )

    async def _own_heading(self) -> OwnHeading | None:
        """Return the autopilot's heading; None where it has none of its own."""
        found, core = self._own.heading(), self._core
        try:
            return found if found is not None and await core.vehicle.kind.yaw_is_its_own(core.parameters) else None
        except AutopilotError:
            return None
