"""V(T, H) of a whole model, as a variance."""

from __future__ import annotations

from companion.config.sections import AllanModel
from companion.estimation.noise.allan import predicted_sigma


def use_variance(model: AllanModel, mean_s: float, horizon_s: float) -> float:
    """V(T, H): variance of (mean over the past T seconds) - (mean of the bias over the next H seconds).

    Args:
        model: the noise of the axis.
        mean_s: T > 0.
        horizon_s: H > 0.
    """
    return predicted_sigma(model, mean_s, horizon_s) ** 2
