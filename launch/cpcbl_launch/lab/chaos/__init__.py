"""Fault scenarios with stated expectations, on real processes over Zenoh."""
