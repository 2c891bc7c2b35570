"""What is tried before a release: `make release-check` and `make compatibility`; both need the network."""
