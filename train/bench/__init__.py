"""`cqn-bench`: methods, tasks and seeds compared."""
