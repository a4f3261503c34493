"""Experiments that need no clock and no port: bytes of simulated devices through decoders and estimator, many seeds."""
