"""Datasets and policies to the Hugging Face Hub."""
