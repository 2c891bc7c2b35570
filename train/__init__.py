"""Configurations, replay, the online loop and its command `cqn-train` (installed as `cqn_train`)."""
