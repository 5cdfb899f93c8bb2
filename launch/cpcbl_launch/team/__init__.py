"""The team file: reading it, its faults and warnings, and what the command line changes in it."""
