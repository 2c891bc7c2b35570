"""Measures, judgements and drawings of `inspect`."""
