"""Recordings: MCAP files of the bytes that came in, and what else a calibration was made from.

Writing raises StorageError, in one line, where the disk refuses; what was written until then can be replayed.
"""
