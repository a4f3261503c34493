"""V(T, H) of a whole model, which the estimator works out in parts."""

from __future__ import annotations

from companion.calibration.noise.allan import AllanModel, floor_variance


def use_variance(model: AllanModel, mean_s: float, horizon_s: float) -> float:
    """V(T, H): variance of (mean over the past T seconds) - (mean of the bias over the next H seconds).

    Args:
        model: the noise of the axis.
        mean_s: T > 0.
        horizon_s: H > 0.
    """
    return model.white**2 / mean_s + float(floor_variance(model.flicker, model.walk, mean_s, horizon_s))
