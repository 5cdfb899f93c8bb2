"""The mathematics of CPCBL: pure functions and immutable data; no bus, clock, thread or file."""
