"""The demos behind `make demo` and `make demo-arm`, with their reports."""
