"""Dataset tools and their command `cqn-data` (installed as `cqn_data`)."""
