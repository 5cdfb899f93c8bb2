"""Faults on purpose: named scenarios with stated expectations, on real processes over Zenoh."""
