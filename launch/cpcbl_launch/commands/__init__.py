"""The commands of `cpcbl-team`, by what they are for; `cli.py` is their table."""
