"""The simulator of bad luck: real agents on a bad network in virtual time (docs/luck.md)."""
