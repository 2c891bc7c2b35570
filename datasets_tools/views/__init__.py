"""A dataset as operations leave it: views on views, nothing written or copied."""
