"""Acting in other processes and on other machines than learning, by Ray (docs/scale.md)."""
