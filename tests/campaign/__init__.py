"""The fault campaign: every fault in every phase of a calibration, judged from outside. `python -m tests.campaign`."""
