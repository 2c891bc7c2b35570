"""`cqn-push`: a run's policy to the Hub."""
