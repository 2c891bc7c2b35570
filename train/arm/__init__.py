"""An arm with a person beside it as an environment of the loop."""
