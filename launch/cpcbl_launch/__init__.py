"""Command line, supervisor, simulated field and evaluation."""
