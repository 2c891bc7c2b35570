"""Coarse-to-fine Q-Network (Seo, Uruç, James 2024) as a LeRobot policy."""
