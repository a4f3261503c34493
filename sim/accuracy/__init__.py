"""Accuracy of the estimator: Monte Carlo of the flying code, beside the physical bound and the common alternatives."""
