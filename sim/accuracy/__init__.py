"""How good the estimator is: Monte Carlo of what flies, beside the physical bound and what else is done."""
