"""The training loop, its evaluations, and the environments it acts in."""
