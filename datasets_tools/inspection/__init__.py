"""What `inspect` measures, judges and draws."""
