"""Formats that ``cqn-data convert`` reads: one file each, with ``open_reader(request)`` or, for LeRobot's own, more."""
