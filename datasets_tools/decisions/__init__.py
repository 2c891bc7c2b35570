"""Decisions on steps, actions, rewards and episodes, as pure functions on arrays."""
