"""The operator's page on the web."""
