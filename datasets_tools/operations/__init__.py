"""One file an operation, the job that runs them, recipes."""
