"""Traces of a run, in its folder and on the terminal: checkpoints, metrics, pictures, progress."""
