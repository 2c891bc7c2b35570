"""Episodes: how they are recorded, read from a dataset, stored and sampled."""
