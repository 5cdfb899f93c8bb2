"""Runs that were recorded: reading them, and having them again."""
