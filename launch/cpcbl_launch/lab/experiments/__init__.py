"""The paper's experiments, and those that it announces, on a simulated field."""
