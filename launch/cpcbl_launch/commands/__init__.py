"""The commands of `cpcbl-team`, by what they are for; `app.py` is their table."""
