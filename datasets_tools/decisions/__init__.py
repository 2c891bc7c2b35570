"""What to keep, drop and change, as pure functions on arrays."""
